"""Ctrl-C or SIGTERM at random times of commands: how often it is lost, and what it leaves.

As a program, ``python test/interruptions.py 200 SIGINT mpc graph``, it prints a line for each
command.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path

from forecast_service import started_service
from places import CHECKOUT, CONFIG

_LIMIT_S = 120.0
# The fork server of a study ends when it has imported what it imports first.
_LEFT_S = 10.0
# A command that ends so soon after the signal had ended, or does nothing wrong.
_OVER_S = 0.02
# What another program that uses the package prints after Ctrl-C.
CLEANED = "cleaned up"
_USER = f"""
import greenroof_ros as gr
try:
    gr.simulate("mpc", hours=2)
except KeyboardInterrupt:
    raise SystemExit(130)
finally:
    print("{CLEANED}", flush=True)
"""
_DRIVE = "gateway://127.0.0.1:45020"
_GREENROOF = {
    "mpc": "simulate --controller mpc --hours 3 --output out",
    "lookahead": "simulate --controller lookahead --horizon 12 --hours 3 --output out",
    "graph": "run --controller mpc --hours 0.5 --output out",
    "graph_onoff": "run --controller onoff --hours 0.5 --output out",
    "study": "study grid.yaml --jobs 2 --output out",
    "report": "report finished --output out",
    "calibrate": "calibrate roof_2025.csv --output out.yaml",
    "bound": "bound --hours 1",
    "verify": "verify forecasts.csv --weather weather.csv --output out.csv",
    "recover": "recover killed --output out",
    "weather": "weather rain.csv --output out.csv",
    "fetch": "fetch-forecast --output out.csv --url",
    "watch": "watch",
    "live": "live --state out --sensors sensors.yaml --forecast forecast.csv "
    f"--drive danfoss_fc202 --drive-at {_DRIVE}",
}
COMMANDS = {
    **{name: f"-m greenroof_ros {words}" for name, words in _GREENROOF.items()},
    "user": "-m user.run",
}
"""The words after the interpreter's name."""
# Those that go on until they are asked to end, with exit code 0: how long at most they are left to
# run (s).
_ENDLESS_S = {"watch": 3.0, "live": 12.0}
_ASKED_TO_END = {"watch", "live"}
GRID = """
site: site.yaml
weather: {file: weather/toronto_2021-07.csv, start: 2021-07-07T02:00-05:00, hours: 0.5}
initial: [low-low, high-low, high-high]
controllers: {mpc: {weight: [0.001, 0.01]}, onoff: {}}
"""


def prepare(directory: Path) -> None:
    """Write what the commands read."""
    (directory / "user").mkdir()
    (directory / "user" / "__init__.py").write_text("import greenroof_ros\n")
    (directory / "user" / "run.py").write_text(_USER)
    (directory / "grid.yaml").write_text(GRID)
    rain = Path(__file__).parent / "data" / "toronto_rain.csv"
    (directory / "rain.csv").write_bytes(rain.read_bytes())
    forecasts = CONFIG / "forecasts/rain_that_never_comes.csv"
    (directory / "forecasts.csv").write_bytes(forecasts.read_bytes())
    weather = CONFIG / "weather/toronto_2021-07.csv"
    (directory / "weather.csv").write_bytes(weather.read_bytes())
    (directory / "roof_2025.csv").write_bytes((CHECKOUT / "examples/roof_2025.csv").read_bytes())
    sensors = (CONFIG / "sensors.yaml").read_text()
    (directory / "sensors.yaml").write_text(sensors.replace(":50", ":450"))
    for run in "finished", "killed":
        words = f"run --controller onoff --hours 0.2 --output {run}"
        subprocess.run(
            [sys.executable, "-m", "greenroof_ros", *words.split()], cwd=directory, check=False,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )
    (directory / "killed/bag/metadata.yaml").unlink()
    bag = directory / "killed/bag/bag_0.mcap"
    os.truncate(bag, bag.stat().st_size * 3 // 4)


# What runs beside a command, and the command's last word.
_BESIDE = {
    "live": (f"-m greenroof_ros simulators site --at {_DRIVE} --sensors sensors.yaml",),
}


@contextmanager
def _service(name: str, directory: Path) -> Iterator[str]:
    """Run what a command needs beside it; yield the command's last word."""
    if name == "fetch":
        with closing(started_service()) as service:
            yield f" {service.address}"
        return
    started = [
        subprocess.Popen(
            [sys.executable, *words.split()], cwd=directory, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for words in _BESIDE.get(name, ())
    ]
    time.sleep(6.0 if started else 0.0)
    try:
        yield ""
    finally:
        for process in started:
            process.kill()
            process.wait()


def interrupt(
    words: str, after_s: float, directory: Path, env: Mapping[str, str],
    number: signal.Signals = signal.SIGINT, codes: Collection[int] = (),
) -> tuple[str, float]:
    """Start a command, send a signal, and return what is wrong, and when it ended.

    Python lists each import when it is done. The time counts from the import of the package itself:
    before, Python starts, and no program can change what Ctrl-C does.

    Args:
        words: of the command, after the interpreter's name.
        after_s: when to send the signal (s).
        directory: with what the command reads.
        env: its environment.
        number: the signal.
        codes: the exit codes of one that was asked to end, beside 130.

    Returns:
        What is wrong, empty for nothing; and how long the command took (s).
    """
    output = directory / "out"
    for old in directory.glob("out*"):
        subprocess.run(["rm", "-r", str(old)], check=True)
    process = subprocess.Popen(
        [sys.executable, *words.split()], cwd=directory, text=True, start_new_session=True,
        env={**env, "PYTHONPROFILEIMPORTTIME": "1"}, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert process.stderr is not None and process.stdout is not None
    for line in process.stderr:
        if line.rpartition("|")[2].strip() == "greenroof_ros":
            break
    began, sent = time.monotonic(), list[float]()

    def send() -> None:
        if process.poll() is None:
            if number == signal.SIGINT:
                os.killpg(process.pid, number)  # as a terminal does
            else:
                process.send_signal(number)
            sent.append(time.monotonic())

    timer = threading.Timer(after_s, send)
    timer.start()
    errors = list[str]()
    reader = threading.Thread(target=lambda: errors.extend(process.stderr or ()))
    reader.start()
    printed = process.stdout.read()
    code = process.wait(_LIMIT_S)
    timer.cancel()
    ended = time.monotonic()
    reader.join(_LIMIT_S)
    took = ended - began
    text = "".join(line for line in errors if not line.startswith("import time:"))
    if not sent or ended - sent[0] < _OVER_S:
        return "", took
    # At its very end Python has no handlers any more, and then the signal itself ends it.
    if code not in (130, -number, *codes):
        return f"exit code {code} {ended - sent[0]:.3f} s after it: {text[-300:]}", took
    if "Traceback" in text:
        return f"a traceback: {text[-2000:]}", took
    # By SIGTERM a program of Python ends at once, unless it has a handler.
    if "user" in words and number == signal.SIGINT and CLEANED not in printed:
        return f"no finally: {text[-300:]}", took
    while left := [it.name for it in Path("/proc").iterdir() if _session(it.name) == process.pid]:
        if time.monotonic() - ended > _LEFT_S:
            return f"processes are left: {left}", took
        time.sleep(0.1)
    file, bag = output / "summary.json", output / "bag"
    if file.exists() and json.loads(file.read_text()).get("status") == "running":
        return "the summary says that it runs", took
    if bag.is_dir() and not (bag / "metadata.yaml").exists():
        return f"the bag is open: {text[-300:]}", took
    return "", took


def _session(entry: str) -> int:
    try:
        return os.getsid(int(entry))
    except (ValueError, ProcessLookupError):
        return 0


def main() -> None:
    """Interrupt each command as often as the first argument says."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)  # a shell's background ignores SIGINT
    count, number, names = int(sys.argv[1]), signal.Signals[sys.argv[2]], sys.argv[3:]
    draw = random.Random(1)
    env = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    with tempfile.TemporaryDirectory() as place:
        directory = Path(place)
        prepare(directory)
        for name in names or COMMANDS:
            with _service(name, directory) as last:
                codes = {0} if name in _ASKED_TO_END else set()
                words, wrong = COMMANDS[name] + last, 0
                takes = _ENDLESS_S.get(name) or interrupt(words, 1e3, directory, env)[1]
                for _ in range(count):
                    after = draw.uniform(0.0, takes)
                    problem, _ = interrupt(words, after, directory, env, number, codes)
                    if problem:
                        wrong += 1
                        print(f"{name}, {after:.3f} of {takes:.3f} s: {problem}", flush=True)
            print(f"{name}, {number.name}: {wrong} of {count} wrong", flush=True)


if __name__ == "__main__":
    main()
