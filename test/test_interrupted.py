"""Ctrl-C at any time of any command: exit code 130 and one line, also while it is imported."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest
from graphs import environment, wait_for
from places import DATA

# When each is interrupted (s), and by what; none but "weather" could be done by then.
SAMPLE = {
    "report finished --output out": (0.1, signal.SIGINT),
    "live --state out --sensors sensors.yaml --forecast forecast.csv": (0.3, signal.SIGTERM),
    "simulate --controller mpc --hours 60 --output out": (1.0, signal.SIGTERM),
    "run --controller mpc --hours 60 --output out": (2.0, signal.SIGINT),
    "weather rain.csv --output out.csv": (0.7, signal.SIGHUP),
    "bound --hours 12": (1.5, signal.SIGINT),
    "size --site site_valve.yaml --weather toronto_2021.csv --gaps fill --output out": (
        3.0, signal.SIGINT
    ),
}


@pytest.mark.parametrize("command", SAMPLE)
def test_a_command_ends_at_any_time_with_130_and_leaves_nothing(
    command: str, tmp_path: Path, domain: int
) -> None:
    """While it is imported, runs, or ends; what two of them need is not there.

    Python lists each import when it is done. The time counts from the import of the package itself:
    before, Python starts, and no program can change what Ctrl-C does.
    """
    after_s, number = SAMPLE[command]
    (tmp_path / "rain.csv").write_bytes((DATA / "toronto_rain.csv").read_bytes())
    process = subprocess.Popen(
        [sys.executable, "-m", "greenroof_ros", *command.split()], cwd=tmp_path, text=True,
        env={**environment(domain), "PYTHONPROFILEIMPORTTIME": "1"}, start_new_session=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    )
    assert process.stderr is not None
    while process.stderr.readline().rpartition("|")[2].strip() != "greenroof_ros":
        assert process.poll() is None
    sent = list[float]()

    def send() -> None:
        if process.poll() is None:
            os.killpg(process.pid, number)  # as a terminal does
            sent.append(time.monotonic())

    timer = threading.Timer(after_s, send)
    timer.start()
    errors = "".join(line for line in process.stderr if not line.startswith("import time:"))
    code, ended = process.wait(300), time.monotonic()
    timer.cancel()
    # At its very end Python has no handlers any more, and then the signal itself ends it.
    over = not sent or ended - sent[0] < 0.02
    others = {"report": 2, "live": 2, "weather": 0}  # refused, or done
    assert over or code in {130, -number, others.get(command.split()[0])}, errors
    assert "Traceback" not in errors
    wait_for(lambda: process.pid not in map(session_of, Path("/proc").iterdir()), 60, "the end")
    file, bag = tmp_path / "out" / "summary.json", tmp_path / "out" / "bag"
    assert not file.exists() or json.loads(file.read_text())["status"] != "running"
    assert not bag.exists() or (bag / "metadata.yaml").exists(), errors
    assert code == 0 or not (tmp_path / "out" / "sizes.html").exists()


def session_of(entry: Path) -> int:
    """Return the session of a process in /proc; 0 for what is none."""
    with suppress(ValueError, ProcessLookupError):
        return os.getsid(int(entry.name))
    return 0


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
from greenroof_ros.simulation.output import write_summary
def slow(*given, write=write_summary): time.sleep(1.5); write(*given)
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


@pytest.mark.parametrize(("command", "number"), [
    ("simulate", signal.SIGTERM), ("run", signal.SIGINT),
])
@pytest.mark.parametrize("words", [
    ("take()", "pass"), ("", "take()"), ("", "time.sleep(0.001)"),
    ("write_summary = slow", "pass"),  # as on a busy disk
])
def test_a_class_that_takes_signals(
    words: tuple[str, str], command: str, number: signal.Signals, tmp_path: Path, domain: int
) -> None:
    (tmp_path / "mine.py").write_text(TAKER.format(*words))
    options = f"{command} --hours 60 --controller mine:Taker --output out"
    options += " --speed 1 --no-record" * (command == "run")
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
    assert (summary["last_tick"] or 0) < summary["steps"] and "total_deviation_m3" not in summary
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
