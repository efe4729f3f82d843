"""Who watches is told, once, that it is the compiler that is being waited for; nobody else is."""

import os
import pty
import subprocess
import sys

import pytest

# Seven programs at least, none of which was compiled before.
CALLS = """
import sys
import jax, vijax
from vijax.runtime import waiting
jax.config.update("jax_compilation_cache_dir", sys.argv[2])
waiting.PATIENCE = float(sys.argv[1])
pair = vijax.impact_pair(0.3, None, 0.5)
jax.jit(lambda x: x + 1)(1.0)
print("vijax", file=sys.stderr)
vijax.trajectory(pair, 0.0, 0.3, periods=1)
"""


def told(patience, folder):
    """What a process writes to a terminal."""
    leader, follower = pty.openpty()
    command = [sys.executable, "-c", CALLS, str(patience), str(folder)]
    with subprocess.Popen(command, stderr=follower) as process:
        assert process.wait() == 0
    os.close(follower)
    written = b""
    try:
        while part := os.read(leader, 4096):
            written += part
    except OSError:  # Linux says so that nobody writes any more
        pass
    os.close(leader)
    return written.decode().split("\r\n")


@pytest.mark.parametrize(("patience", "lines"), [(0.001, 1), (1000.0, 0)])
def test_a_terminal_is_told_once_of_a_long_wait(tmp_path, patience, lines):
    first, *others = told(patience, tmp_path)
    # A program of somebody else's is none of our business.
    assert first == "vijax"
    assert sum("compiling" in line for line in others) == lines


def test_nobody_else_is_told(tmp_path):
    command = [sys.executable, "-c", CALLS, "0.001", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stderr == "vijax\n"
