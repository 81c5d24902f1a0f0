"""The document in a terminal: what fits, in which characters, and how it begins and ends."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import struct
import subprocess
import sys
import termios
import time
from io import BytesIO, TextIOWrapper
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from places import CHECKOUT
from rich.cells import cell_len
from rich.console import Console
from said import ERROR, SECOND, START, hear, node, silent_sensor, store

from greenroof_ros.model.look_ahead import growing_steps
from greenroof_ros.watch.document import document as read_document
from greenroof_ros.watch.document import series as read_series
from greenroof_ros.watch.store import Store
from greenroof_ros.watch.terminal import _Release, pages
from greenroof_ros.watch.wire import Status


def run_of(
    hours: float, mode: str = "simulated", pump: str = "/pump", wall: float = 99.0
) -> Store:
    """Return a run in which the roof's level rises by 1 mm/h from 40 mm, and it rains now."""
    graph = store(mode)
    times = START + 10 * SECOND * np.arange(int(hours * 360) + 1)
    passed = (times - START) / 3.6e12
    for topic, values in {
        "/roof/level": 0.040 + 0.001 * passed, "/cistern/level": 2.5 - 0.01 * passed,
        "/pump/command": np.full(len(times), 0.4), "/pump/flow": np.full(len(times), 0.0033),
        "/weather/precipitation": np.where(passed > hours / 2, 1e-6, 0.0),
    }.items():
        graph.add(topic, times, values)
    graph.add_statuses(wall, [
        *node("/onoff", "controller"), *node(pump, "pump", pump="running: as commanded"),
    ])
    return graph


def with_storm() -> Store:
    graph = run_of(6.0)
    now, ends = START + 6 * 3600 * SECOND, growing_steps(12)[1:]
    rain = np.outer(np.arange(1.0, 12.0), [1e-7] * 32)
    graph.add_forecast(now, rain, np.array([now / 1e9, *ends]))
    levels = np.linspace(0.046, 0.050, 32)
    graph.add_plan(now, np.column_stack([ends, np.full(32, 1e-4), levels]))
    return graph


def with_a_fault() -> Store:
    why = "fault: the drive reports: overcurrent (code 2310); the drive is not ready"
    graph = run_of(6.0, "loop")
    graph.add_statuses(99.5, node(
        "/pump", "pump", ("pump", ERROR, why, "drive_fault"),
        ("drive", ERROR, "the drive reports a fault: over", "drive_fault"),
        pump=why, fault="the drive reports: overcurrent (code 2310)",
    ))
    return graph


def with_a_silent_sensor(others: int = 0, wall: float = 99.5) -> Store:
    graph = run_of(6.0, "live", wall=wall)
    graph.add_statuses(wall, [
        *silent_sensor(),
        *(Status(f"/camera{number}", ERROR, "no picture") for number in range(others)),
    ])
    return graph


def with_a_stop_of_the_page() -> Store:
    """Return a site with a pump that can be released here, and a fault that can be cleared."""
    graph = run_of(1.0, "live")
    graph.allow_release = True
    graph.add_statuses(99.5, node(
        "/pump", "pump", pump="held: a hold by the page", hold={"said": "a hold by the page"},
        stands=True, fault="a slow start", no_clear="",
    ))
    return graph


STATES = {
    "full speed": lambda: run_of(2.0), "storm": with_storm, "fault": with_a_fault,
    "stale sensor": with_a_silent_sensor, "stop of the page": with_a_stop_of_the_page,
    "nothing": Store, "many alarms": lambda: with_a_silent_sensor(90),
}


def all_drawn(
    graph: Store, width: int = 80, height: int | None = 24, *, ascii_only: bool = False
) -> list[list[str]]:
    """Return the lines of each page of the terminal."""
    document, series = read_document(graph, 100.0), read_series(graph, 12.0)
    console = Console(
        width=width, height=height, force_terminal=True, highlight=False, color_system=None,
        file=TextIOWrapper(BytesIO(), "ascii" if ascii_only else "utf-8"),
    )
    texts = []
    for page in pages(document, series, console, height):
        with console.capture() as captured:
            console.print(page)
        texts.append(captured.get().splitlines())
    return texts


def drawn(graph: Store, width: int = 80, height: int | None = 24, **more: bool) -> list[str]:
    """Return the first page."""
    return all_drawn(graph, width, height, **more)[0]


def test_an_alarm_from_before_the_watcher_is_dated_as_on_the_page() -> None:
    assert any("since before 11:00:00" in line for line in drawn(with_a_silent_sensor()))


@pytest.mark.parametrize("size", [(80, 24), (200, 12), (40, 10), (10, 3)])
@pytest.mark.parametrize("state", ["storm", "fault", "nothing", "many alarms"])
def test_it_fits(state: str, size: tuple[int, int]) -> None:
    width, height = size
    for lines in all_drawn(STATES[state](), width, height):
        assert len(lines) == height
        assert max(map(cell_len, lines)) <= max(width, 40)


@pytest.mark.parametrize(("state", "words"), [
    ("full speed", ["Simulated run, 30 times real time", "No alarms.",
                    "What to do: Nothing to do: the pump waters the roof.",
                    "below its target (target 45.7 mm)",
                    "(suction level 750 mm, outlet 3000 mm)"]),
    ("storm", ["expected in the next 12 h", "next 12 h, as expected", "will pump"]),
    ("fault", ["The drive has switched the pump off", "ros2 service call /pump/reset",
               "fault", "overcurrent (code 2310)", "Alarm  /pump: pump"]),
    ("stale sensor", ["1 alarm (4 more caused by these).", "The sensor sends nothing,",
                      "Alarms: 5 now, 0 over",
                      "Alarm  /cistern_sensor: sensor", "no valid answer", "Live site", "held",
                      "follows from /cistern_sensor: sensor"]),
    ("stop of the page", ["r releases the pump; c clears its fault"]),
    ("nothing", ["Nothing is heard yet"]),
    ("many alarms", ["/cistern_sensor: sensor", "The sensor sends nothing,", " more"]),
])
def test_what_must_be_seen_at_80_by_24(state: str, words: list[str]) -> None:
    lines = drawn(STATES[state]())
    text = " ".join(" ".join(lines).split())
    for said in words:
        assert " ".join(said.split()) in text, "\n".join(lines)
    for tile in ("Roof level", "Cistern level", "Pump ", "Rain ", "Controller"):
        assert any(line.startswith(tile) for line in lines), tile


def test_all_of_it_by_turning_pages() -> None:
    """A hundred alarms with their advice, the account and each event are on some page."""
    graph = with_a_silent_sensor(90)
    for number in range(30):
        graph.add_event(99.5, f"event {number}")
    document = read_document(graph, 100.0)
    told = all_drawn(graph)
    assert all(len(page) == 24 for page in told)
    assert told[-1][-1].startswith(f"page {len(told)} of {len(told)};")
    text = " ".join(" ".join(line for page in told for line in page[:-1]).split())
    sentences = [
        *(text for row in document["alarms"] for text in (row["id"], row["what"])),
        *(event["what"] for event in document["events"]),
        *(f"{row['label'].lower()} {row['value']}" for row in document["account"]["rows"]
          if row["number"] is not None),
    ]
    assert len(sentences) > 200
    for sentence in sentences:
        assert " ".join(sentence.split()) in text, sentence
    whole = " ".join(" ".join(drawn(graph, height=None)).split())
    assert text.startswith(whole[:5000])
    assert "space turns the page" not in whole


def chart(lines: list[str], label: str) -> str:
    """Return the line of a chart: its label, range and bars."""
    (bars,) = (line for line in lines if line.startswith(f"{label:9}") and "|" in line)
    return bars


def test_bars_by_hand() -> None:
    """Twelve hours in 26 columns of greatest values: the first column ends at 40.46 mm.

    The range starts at 40.0 mm, so the bar of column c is round(7 (c + 1) / 26), halves rounded
    down. A constant is drawn at half height, zero at the lowest.
    """
    graph = run_of(12.0)
    lines = drawn(graph, 80, 30)
    roof = chart(lines, "Roof")
    assert roof[9:27].strip() == "40.0-52.0 mm"
    assert roof[27:53] == "▁▂▂▂▂▃▃▃▃▄▄▄▄▅▅▅▆▆▆▆▇▇▇▇██"
    assert chart(lines, "Rain")[27:53] == "▁" * 13 + "█" * 13
    assert chart(lines, "Pump")[27:53] == "▅" * 26
    plain = chart(drawn(graph, 80, 30, ascii_only=True), "Roof")
    assert plain[27:53] == "_....::::----===++++****##"
    graph = store()
    hear(graph, 0, 43_210, {"/pump/flow": 0.0}, every=10)
    assert chart(drawn(graph, 80, 30), "Pump")[27:53] == "▁" * 26


def test_a_chart_has_the_range_of_all_values() -> None:
    """A gust of rain between two columns' last values is shown, and so is the least level."""
    graph = run_of(12.0)
    times = START + 12 * 3600 * SECOND + SECOND * np.arange(1, 41)
    graph.add("/weather/precipitation", times, np.where(np.arange(40) == 5, 1e-5, 0.0))
    graph.add("/cistern/level", times, np.where(np.arange(40) == 5, 1.0, 2.38))
    lines = drawn(graph, 80, 30)
    rain = chart(lines, "Rain")
    assert "0.0-36.0 mm/h" in rain
    assert rain[52] == "█"
    assert "1000-2500 mm" in chart(lines, "Cistern")


def test_hostile_texts_do_nothing_to_the_terminal() -> None:
    graph = run_of(1.0)
    evil = "\x1b]0;title\x07\x1b[2J[red]x[/red]\u202e\ud800 日本" * 5
    graph.add_statuses(99.5, [Status("/x\x1b[31m", ERROR, evil)])
    graph.add_event(99.5, evil)
    for ascii_only in (False, True):
        text = "\n".join(drawn(graph, 120, 50, ascii_only=ascii_only))
        assert "\x1b" not in text
        assert "\u202e" not in text
        assert "[red]x[/red]" in text
        assert text.isascii() == ascii_only
        assert f"{'m3' if ascii_only else 'm³'} above the suction level" in text


# --- as a process on a terminal -------------------------------------------------------------------

PROGRAM = f"""
import sys, time
sys.path[:0] = [{str(CHECKOUT / "test")!r}, {str(Path(__file__).parent)!r}]
from test_terminal import with_a_silent_sensor
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.terminal import run
store = with_a_silent_sensor(wall=time.monotonic())
run(store, Feed(store))
"""


class Terminal:
    """A terminal of 80 by 24 that controls a process."""

    def __init__(self, *arguments: str, cwd: Path = CHECKOUT, **environment: str) -> None:
        self._main, self._of_process = pty.openpty()
        self.resize(80, 24)
        self.before = termios.tcgetattr(self._of_process)
        variables = {
            key: value for key, value in os.environ.items()
            if key not in ("NO_COLOR", "COLUMNS", "LINES", "FORCE_COLOR")
        }

        def take() -> None:
            os.setsid()
            fcntl.ioctl(self._of_process, termios.TIOCSCTTY, 0)

        self.process = subprocess.Popen(
            [sys.executable, *arguments], stdin=self._of_process, stdout=self._of_process,
            stderr=self._of_process, cwd=cwd, preexec_fn=take,
            env={**variables, "TERM": "xterm-256color", "PYTHONUTF8": "1", **environment},
        )
        self.text = ""

    def resize(self, width: int, height: int) -> None:
        size = struct.pack("HHHH", height, width, 0, 0)
        fcntl.ioctl(self._of_process, termios.TIOCSWINSZ, size)

    def read_until(self, words: str, seconds: float = 60.0) -> None:
        """Read until some text is written, from now on."""
        self.text, until = "", time.monotonic() + seconds
        while words not in self.text:
            assert time.monotonic() < until, self.text
            self._read(0.1)

    def _read(self, seconds: float) -> None:
        if select.select([self._main], [], [], seconds)[0]:
            self.text += os.read(self._main, 65536).decode(errors="replace")

    def press(self, keys: bytes) -> None:
        os.write(self._main, keys)

    def ends(self, seconds: float = 60.0) -> int:
        """Return the exit code, and check that the terminal is restored."""
        until = time.monotonic() + seconds
        while self.process.poll() is None:
            assert time.monotonic() < until, "it does not end"
            self._read(0.05)
        self._read(0.2)
        assert termios.tcgetattr(self._of_process) == self.before
        assert "Traceback" not in self.text
        return self.process.returncode

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *failure: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        for end in (self._main, self._of_process):
            os.close(end)


@pytest.mark.parametrize("no_color", [{}, {"NO_COLOR": "1"}])
def test_it_is_drawn_again_when_the_terminal_changes_and_ends_on_q(
    no_color: dict[str, str]
) -> None:
    """Keys without a meaning here do nothing."""
    with Terminal("-c", PROGRAM, **no_color) as terminal:
        terminal.read_until("greenroof hold")
        assert "\x1b[?1049h" in terminal.text  # the alternate screen
        assert bool(re.search(r"\x1b\[[0-9;]*m", terminal.text)) == (not no_color)
        terminal.press(b"xrycy ")
        terminal.read_until("page 2 of ")
        terminal.resize(120, 60)
        terminal.read_until("Last 6 h")
        began = time.monotonic()
        terminal.press(b"q")
        assert terminal.ends() == 0
        assert time.monotonic() - began < 20.0
        assert "\x1b[?1049l" in terminal.text  # the previous content is restored
        assert "\x1b[?25h" in terminal.text


@pytest.mark.parametrize(("key", "question", "action"), [
    (b"r", "Release the pump? It stays off all the same: a slow start.", "release"),
    (b"c", "Clear the fault? The fault is cleared: a slow start.", "clear"),
])
def test_a_key_asks_and_only_y_confirms_what_was_asked(
    key: bytes, question: str, action: str
) -> None:
    """Keys typed together with the question confirm nothing: nobody has read it."""
    stop = read_document(with_a_stop_of_the_page(), 100.0)["stop"]
    release = _Release(SimpleNamespace(ask=lambda action: f"asked for: {action}"))

    def said_to(keys: bytes, **changed: object) -> str:
        release.press(keys, stop | changed)
        return release.asks

    assert said_to(b"y") == ""
    assert said_to(key).startswith(question)
    assert said_to(b"ny") == ""
    assert said_to(key + b"y").startswith(question)
    assert said_to(b"y") == f"asked for: {action}"
    for changed in ({f"{action}_then": "Another."}, {f"{action}_here": False}):
        said_to(key)
        assert said_to(b"y", **changed).startswith("Nothing was done")


def test_what_cannot_be_drawn_over_is_printed() -> None:
    """Into a pipe, until SIGTERM, and on a dumb terminal."""
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        cwd=CHECKOUT, env={**os.environ, "PYTHONUTF8": "1"},
    ) as process, Terminal("-c", PROGRAM, TERM="dumb") as terminal:
        assert process.stdout is not None
        lines = [process.stdout.readline() for _ in range(10)]
        assert lines[0].startswith("Live site")
        process.terminate()
        rest, errors = process.communicate(timeout=120)
        terminal.read_until("greenroof hold")
        terminal.press(b"Q")
        assert terminal.ends() == 0
    assert "\x1b" not in rest + terminal.text
    assert (process.returncode, errors) == (0, "")
