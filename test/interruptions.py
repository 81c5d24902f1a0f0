"""Ctrl-C at random times of commands: how often it is lost, and what it leaves.

As a program, ``python test/interruptions.py 200 mpc graph``, it prints a line for each command.
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
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

_LIMIT_S = 120.0
# The fork server of a study ends when it has imported what it imports first.
_LEFT_S = 10.0
# What another program that uses the package prints after Ctrl-C.
CLEANED = "cleaned up"
_USER = f"""
import greenroof_ros as gr
try:
    gr.simulate("mpc", hours=12)
except KeyboardInterrupt:
    raise SystemExit(130)
finally:
    print("{CLEANED}", flush=True)
"""
COMMANDS = {
    "mpc": "-m greenroof_ros simulate --controller mpc --hours 3 --output out",
    "graph": "-m greenroof_ros run --controller mpc --hours 0.5 --output out",
    "study": "-m greenroof_ros study grid.yaml --jobs 2 --output out",
    "report": "-m greenroof_ros report finished --output out",
    "weather": "-m greenroof_ros weather rain.csv",
    "user": "-m user.run",
}
"""The words after the interpreter's name."""
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
    subprocess.run(
        [sys.executable, "-m", "greenroof_ros", "simulate", "--controller", "onoff", "--hours",
         "1", "--trajectory", "--output", "finished"], cwd=directory, check=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )


def interrupt(
    words: str, after_s: float, directory: Path, env: Mapping[str, str]
) -> tuple[str, float]:
    """Start a command, send SIGINT, and return what is wrong, and when it ended.

    Python lists each import when it is done. The time counts from the import of the package itself:
    before, Python starts, and no program can change what Ctrl-C does.

    Args:
        words: of the command, after the interpreter's name.
        after_s: when to send the signal (s).
        directory: with what the command reads.
        env: its environment.

    Returns:
        What is wrong, empty for nothing; and how long the command took (s).
    """
    output = directory / "out"
    if output.exists():
        subprocess.run(["rm", "-r", str(output)], check=True)
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
            os.killpg(process.pid, signal.SIGINT)  # as a terminal does
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
    if not sent:
        return "", took
    if code not in (130, -signal.SIGINT):  # both are 130 in a shell; the latter as Python ends
        return f"exit code {code} {ended - sent[0]:.3f} s after it: {text[-300:]}", took
    if "Traceback" in text:
        return f"a traceback: {text[-2000:]}", took
    if "user" in words and CLEANED not in printed:
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
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores it
    count, names = int(sys.argv[1]), sys.argv[2:] or list(COMMANDS)
    draw = random.Random(1)
    env = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    for name in names:
        with tempfile.TemporaryDirectory() as place:
            directory = Path(place)
            prepare(directory)
            _, takes = interrupt(COMMANDS[name], 1e3, directory, env)
            wrong: Counter[str] = Counter()
            for _ in range(count):
                after = draw.uniform(0.0, takes)
                problem, _ = interrupt(COMMANDS[name], after, directory, env)
                if problem:
                    wrong[problem] += 1
                    print(f"{name}, {after:.3f} of {takes:.3f} s: {problem}", flush=True)
        print(f"{name}: {wrong.total()} of {count} wrong", flush=True)


if __name__ == "__main__":
    main()
