"""Ctrl-C at any time of any command: exit code 130 and one line, also while it is imported."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from graphs import environment

# Commands that go on until they are ended, with what they need.
LONG = {
    "simulate": "--hours 60 --start 2021-07-07T02:00 --speed 1",
    "run": "--hours 60 --start 2021-07-07T02:00 --speed 1 --no-record",
    "bound": "--block 1 --hours 3",
}


def interrupted(directory: Path, words: str, after_s: float) -> tuple[int, str]:
    """Start a command, send SIGINT, and return exit code and standard error.

    Python lists each import there when it is done. The time counts from the import of the package
    itself: before, Python starts, and no program can change what Ctrl-C does.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", "greenroof_ros", *words.split()], cwd=directory, text=True,
        env={**environment(0), "PYTHONPROFILEIMPORTTIME": "1"}, stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    assert process.stderr is not None
    for line in process.stderr:
        if line.rpartition("|")[2].strip() == "greenroof_ros":
            break
    threading.Timer(after_s, process.send_signal, [signal.SIGINT]).start()
    lines = [line for line in process.stderr if not line.startswith("import time:")]
    return process.wait(300), "".join(lines)


@pytest.mark.parametrize(
    ("name", "after_s"), [("simulate", 0.0), ("run", 0.25), ("bound", 0.5)]
)
def test_a_command_that_runs(name: str, after_s: float, tmp_path: Path) -> None:
    code, error = interrupted(tmp_path, f"{name} {LONG[name]}", after_s)
    assert code == 130, error
    assert "Traceback" not in error and "interrupted" in error


@pytest.mark.parametrize("name", ["live", "report"])
def test_a_command_while_it_is_imported(name: str, tmp_path: Path) -> None:
    """Its help imports what it imports: it ends with 130, or is done before."""
    code, error = interrupted(tmp_path, f"{name} --help", 0.1)
    assert (code, error) in ((130, "interrupted\n"), (0, "")), error


def test_a_background_command_ignores_it_as_the_shell_asked(tmp_path: Path) -> None:
    done = subprocess.run(
        ["sh", "-c", f"{sys.executable} -m greenroof_ros simulate --hours 1 > /dev/null & "
                     "sleep 0.2; kill -INT $!; wait $!; echo $?"],
        cwd=tmp_path, env=environment(0), capture_output=True, text=True, check=True, timeout=300,
    )
    assert done.stdout.strip() == "0", done.stderr


def test_a_program_that_imports_the_package_keeps_its_own_handler() -> None:
    program = (
        "import signal, greenroof_ros.commands.simulate\n"
        "print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment(0), capture_output=True, text=True,
        check=True, timeout=300,
    )
    assert done.stdout.strip() == "True"
