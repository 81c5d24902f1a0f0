"""Ctrl-C at any time of any command: exit code 130 and one line, also while it is imported."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from graphs import environment, wait_for
from interruptions import COMMANDS, interrupt
from places import DATA

# Commands that go on until they are ended, with what they need.
LONG = {
    "simulate": "--hours 60 --start 2021-07-07T02:00",
    "run": "--hours 60 --start 2021-07-07T02:00 --speed 1 --no-record",
}


@pytest.mark.parametrize(
    ("name", "after_s", "number"), [
        ("report", 0.1, signal.SIGINT), ("live", 0.3, signal.SIGTERM),
        ("mpc", 1.0, signal.SIGTERM), ("graph", 2.0, signal.SIGINT),
        ("weather", 0.7, signal.SIGHUP), ("bound", 1.5, signal.SIGINT),
    ],
)
def test_a_sample_of_interruptions(
    name: str, after_s: float, number: signal.Signals, tmp_path: Path, domain: int
) -> None:
    """While a command is imported, runs, or ends; the program of that module has many more."""
    (tmp_path / "rain.csv").write_bytes((DATA / "toronto_rain.csv").read_bytes())
    codes = (0, 2) if name in ("report", "live") else ()  # what they need is not there
    words, env = COMMANDS[name], environment(domain)
    assert interrupt(words, after_s, tmp_path, env, number, codes)[0] == ""


def test_a_background_command_ignores_it_as_the_shell_asked(tmp_path: Path) -> None:
    done = subprocess.run(
        ["sh", "-c", f"{sys.executable} -m greenroof_ros simulate --hours 1 > /dev/null & "
                     "sleep 0.2; kill -INT $!; wait $!; echo $?"],
        cwd=tmp_path, env=environment(0), capture_output=True, text=True, check=True, timeout=300,
    )
    assert done.stdout.strip() == "0", done.stderr


# A user's class that takes signals for itself, or goes on after them.
TAKER = """
import signal, time
from pathlib import Path
from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.simulation import summary
def slow(*given, write=summary.write): time.sleep(1.5); write(*given)
def take(): [signal.signal(n, lambda *_: None) for n in (signal.SIGINT, signal.SIGTERM)]
{}
class Taker(OnOff):
    parameters = ()
    def __init__(self, site): super().__init__(site, 1.0)
    def command(self, *inputs):
        Path("ready").touch()
        try:
            {}
        except BaseException: pass
        return super().command(*inputs)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("command", ["simulate", "run"])
@pytest.mark.parametrize("words", [
    ("take()", "pass"), ("", "take()"), ("", "time.sleep(0.001)"),
    ("summary.write = slow", "pass"),  # as on a busy disk
])
def test_a_class_that_takes_signals(
    words: tuple[str, str], command: str, number: signal.Signals, tmp_path: Path, domain: int
) -> None:
    (tmp_path / "mine.py").write_text(TAKER.format(*words))
    options = f"{command} {LONG[command]} --controller mine:Taker --output out"
    process = subprocess.Popen(
        [sys.executable, "-m", "greenroof_ros", *options.split()], cwd=tmp_path, text=True,
        env=environment(domain), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    )
    wait_for((tmp_path / "ready").exists, 120, "its first command")
    process.send_signal(number)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130, error
    assert "Traceback" not in error and "interrupted" in error
    assert "recorded" not in error  # neither command records
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["status"], summary["reason"]) == (
        "interrupted", f"interrupted by {number.name}"
    )


USER = """
from concurrent.futures import ThreadPoolExecutor
def work():
    import greenroof_ros as gr, greenroof_ros.commands.simulate
    print("working", flush=True)
    gr.simulate("mpc", hours=2)
def test_all():
    try:
        {}
    except KeyboardInterrupt:
        print("cleaned up", flush=True)
if __name__ == "__main__": test_all()
"""
CALL, POOL = "work()", "with ThreadPoolExecutor() as pool: pool.submit(work).result()"


@pytest.mark.parametrize(
    ("words", "call"), [
        ("-c import~test_user;test_user.test_all()", CALL), ("-m test_user", CALL),
        ("-m pytest -s", CALL), ("bin/user", CALL), ("-m test_user", POOL),
    ],
)
def test_a_program_that_uses_the_package_keeps_its_own_handlers(
    words: str, call: str, tmp_path: Path
) -> None:
    """However it is started, what its author wrote after ``except`` is done."""
    (tmp_path / "bin").mkdir()
    for file in ("test_user.py", "bin/user"):
        (tmp_path / file).write_text(USER.format(call))
    process = subprocess.Popen(
        [sys.executable, *(word.replace("~", " ") for word in words.split())], cwd=tmp_path,
        env=environment(0), stdout=subprocess.PIPE, text=True,
    )
    assert process.stdout is not None
    while "working" not in process.stdout.readline():
        assert process.poll() is None
    threading.Timer(0.3, process.send_signal, [signal.SIGINT]).start()
    assert "cleaned up" in process.communicate(timeout=300)[0]
