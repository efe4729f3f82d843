"""Ctrl-C at every moment of a command: one line, exit code 130, nothing half-written; and processes without streams.

Moments are measured in processor time, so that the command is at the same place on a busy machine.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import click
import pytest

import vijax
from tests.helpers import SCRIPTS
from vijax.cli import process, signals

ROOT = SCRIPTS.parent
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="moments are read from /proc")

# The command with a handler of SIGINT; a shell ignores SIGINT for background processes.
COMMAND = """
import signal
signal.signal(signal.SIGINT, signal.{handler})
from vijax.__main__ import command
command()
"""
INTERRUPTIBLE, IGNORING = (COMMAND.format(handler=handler) for handler in ("default_int_handler", "SIG_IGN"))
STOPPED = "stopped; nothing half-written is left\n"
REFUSED = ["sweep", "--d", "0.2", "--kappa", "nan"]


def processor_time(process: subprocess.Popen) -> float:
    """Return the processor time of a process [s]."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def interrupted(code: str, seconds: float, folder: Path, arguments=(), which=signal.SIGINT):
    """Send a signal to a process; return the exit code and the standard error of the process."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code, *arguments]
    with subprocess.Popen(command, cwd=folder, env=environment, **pipes) as started:
        try:
            while started.poll() is None and processor_time(started) < seconds:
                time.sleep(0.001)
            assert started.poll() is None, started.stderr.read()
            started.send_signal(which)
            _, err = started.communicate(timeout=60)
        finally:
            started.kill()
    return started.returncode, err


@pytest.fixture(scope="module")
def refusal():
    """The processor time of a command line that is refused [s]."""
    environment, before = os.environ | {"PYTHONPATH": str(ROOT)}, os.times()
    command = [sys.executable, "-c", INTERRUPTIBLE, *REFUSED]
    assert subprocess.run(command, env=environment, capture_output=True, check=False).returncode == 2
    after = os.times()
    return after.children_user - before.children_user + after.children_system - before.children_system


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5, 0.75])
def test_ctrl_c_during_validation_prints_a_single_line(tmp_path, refusal, share):
    """The line would be refused, too. An exception in a callback of an import would be lost."""
    assert interrupted(INTERRUPTIBLE, share * refusal, tmp_path, REFUSED) == (130, STOPPED)
    assert not list(tmp_path.iterdir())


def test_sigterm_during_validation_has_its_exit_code(tmp_path):
    assert interrupted(INTERRUPTIBLE, 0.5, tmp_path, REFUSED, signal.SIGTERM) == (143, STOPPED)


def test_a_process_that_ignores_sigint_is_not_stopped(tmp_path):
    code, err = interrupted(IGNORING, 0.15, tmp_path, ["sweep", "--wall", "x"])
    assert (code, err.partition(" ")[0]) == (2, "error:")


# A program that interrupts itself where Python drops an exception, and would then sleep for a minute.
DROPPED = """
import os, signal, time
import click
from vijax.cli import process

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores it for background processes

class Dropped:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        sum(range(1000))  # the handler runs here

def work():
    with process.usage_errors():
        pass
    Dropped()
    time.sleep(60)

process.command(lambda: process.run(click.Command("work", callback=work), []))
"""


def test_an_interrupt_that_python_drops_is_raised_again():
    result = subprocess.run([sys.executable, "-c", DROPPED], capture_output=True, text=True, timeout=30, cwd=ROOT)
    assert (result.returncode, result.stderr.strip()) == (130, STOPPED.strip())


# A run with a second Ctrl-C during its clean-up.
TWICE = """
import os, signal, time
import click
from vijax.cli import process

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores it for background processes

def work():
    with process.usage_errors():
        pass
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(60)
    finally:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.1)
        print("cleaned up", flush=True)

process.command(lambda: process.run(click.Command("work", callback=work), []))
"""


def test_a_second_ctrl_c_does_not_stop_the_clean_up():
    result = subprocess.run([sys.executable, "-c", TWICE], capture_output=True, text=True, timeout=30, cwd=ROOT)
    assert (result.returncode, result.stdout, result.stderr.strip()) == (130, "cleaned up\n", STOPPED.strip())


def test_handlers_of_a_program_that_calls_the_command_are_restored():
    before = [signal.getsignal(number) for number in signals.CODES]
    handlers = []
    probe = click.Command("look", callback=lambda: handlers.extend(map(signal.getsignal, signals.CODES)))
    assert process.run(probe, []) == 0
    assert all(handler is signals._handle for handler in handlers if handler is not signal.SIG_IGN)
    assert [signal.getsignal(number) for number in signals.CODES] == before
    assert not signals.SignalState.owned


# A run that shows its progress and writes a file.
WRITES = """
import click
from vijax.cli import process
from vijax.cli.progress import progress

def work():
    with process.usage_errors():
        pass
    with progress(3) as show, open("file", "w") as file:
        show(3, 3)
        file.write("whole")

process.command(lambda: process.run(click.Command("work", callback=work), []))
"""


@pytest.mark.parametrize("closed", ["2>&-", "0<&- 1>&- 2>&-"])
def test_closed_streams_stop_no_run(tmp_path, closed):
    """Progress and messages on the standard error are not written into a file of the run, either."""
    (tmp_path / "run.py").write_text(WRITES)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    result = subprocess.run(["bash", "-c", f"{sys.executable} run.py {closed}"], cwd=tmp_path, env=environment)
    assert result.returncode == 0
    assert (tmp_path / "file").read_text() == "whole"


OPEN_FILE = "import os, sys; from vijax.cli import process; process._open_streams(); file = open(os.devnull); "


@pytest.mark.parametrize("closed", ["2>&-", "0<&- 2>&-", "1>&- 2>&-", "0<&- 1>&- 2>&-"])
def test_no_file_has_the_number_of_a_closed_stream(closed):
    code = f"{OPEN_FILE}print('', file=sys.stderr); os._exit(file.fileno())"
    line = f'{sys.executable} -c "{code}" {closed}'
    result = subprocess.run(["bash", "-c", line], cwd=ROOT, check=False)
    assert result.returncode > 2


@pytest.mark.parametrize("call", [lambda path: vijax.sweep(d=0.2, kappa=40.0, out=path), vijax.load, vijax.explore])
def test_a_working_directory_that_was_deleted_is_named(tmp_path, monkeypatch, call):
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    with pytest.raises(FileNotFoundError, match=r"must be an absolute path, as the working directory was deleted; got"):
        call("map.zarr")
    assert not list(tmp_path.iterdir())
