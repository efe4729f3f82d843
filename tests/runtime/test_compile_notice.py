"""A terminal shows one message if compilation takes long; other streams show none."""

import os
import pty
import subprocess
import sys

import pytest

# At least seven programs; none was compiled before.
CALLS = """
import sys
import jax, vijax
from vijax.runtime.compilation import compile_notice
jax.config.update("jax_compilation_cache_dir", sys.argv[2])
compile_notice.NOTICE_DELAY = float(sys.argv[1])
pair = vijax.impact_pair(0.3, None, 0.5)
jax.jit(lambda x: x + 1)(1.0)
print("vijax", file=sys.stderr)
vijax.trajectory(pair, 0.0, 0.3, periods=1)
"""


def terminal_output(delay, folder):
    """Return the lines that a process writes to a terminal."""
    leader, follower = pty.openpty()
    command = [sys.executable, "-c", CALLS, str(delay), str(folder)]
    with subprocess.Popen(command, stderr=follower) as process:
        assert process.wait() == 0
    os.close(follower)
    written = b""
    try:
        while part := os.read(leader, 4096):
            written += part
    except OSError:  # Linux raises it when no process writes any more
        pass
    os.close(leader)
    return written.decode().split("\r\n")


@pytest.mark.parametrize(("delay", "lines"), [(0.001, 1), (1000.0, 0)])
def test_a_terminal_shows_a_single_message_for_a_long_compilation(tmp_path, delay, lines):
    first, *others = terminal_output(delay, tmp_path)
    # The program of the caller, which is compiled first, causes no message.
    assert first == "vijax"
    assert sum("compiling" in line for line in others) == lines


def test_there_is_no_message_without_a_terminal(tmp_path):
    command = [sys.executable, "-c", CALLS, "0.001", str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stderr == "vijax\n"
