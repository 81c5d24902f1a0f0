"""The supervision of a live site, with real processes: restarts, back-off, limit, drive."""

from __future__ import annotations

import gc
import os
import resource
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path

import pytest
from graphs import alive, wait_for
from places import CHECKOUT

from greenroof_ros.base.disk import DISK
from greenroof_ros.live import restarts
from greenroof_ros.live.supervisor import LiveSupervisor, NodeFailed, ProcessStart

TOO_LONG_S = 60


def process(
    name: str, marks: Path, instead: Callable[[str], tuple[str, ...]] | None = None
) -> ProcessStart:
    """Return a small process; see :mod:`small_node`."""
    return ProcessStart(name, "small_node", (name, str(marks)), {}, instead)


class Site:
    """A supervisor, and a record of what its processes and drive have done."""

    def __init__(self, directory: Path, *processes: str | ProcessStart, silence_s: float = 5.0):
        """Begin without a process."""
        self.directory, self.marks = directory, directory / "marks"
        self.marks.mkdir(exist_ok=True)
        self.told: list[str] = []
        self.stops: list[float] = []
        self.may_run = False  # whether the drive cannot be stopped
        self.longest_step = 0.0  # of the supervision (s)

        def stop_drive(_pump_node: int, _reached: bool) -> tuple[bool, str]:
            self.stops.append(time.monotonic())
            return self.may_run, "the drive stands"

        self.supervisor = LiveSupervisor(
            [process(each, self.marks) if isinstance(each, str) else each for each in processes],
            directory, [], stop_drive, self.told.append, silence_s=silence_s, prepare=dict,
        )
        self._ending = ExitStack()
        self._ending.enter_context(self.supervisor)
        self.end = self._ending.close

    def until(self, condition: Callable[[], object], seconds: float = TOO_LONG_S) -> None:
        """Supervise until a condition holds."""

        def step() -> bool:
            began = time.monotonic()
            self.supervisor.read()
            self.supervisor.update()
            self.longest_step = max(self.longest_step, time.monotonic() - began)
            return bool(condition())

        wait_for(step, seconds, "what the test waits for")

    def until_ready(self) -> None:
        """Supervise until every process is ready."""
        self.until(lambda: not self.supervisor.unready)

    def during(self, seconds: float) -> None:
        """Supervise for this long (s)."""
        ended = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > ended)

    def starts(self, name: str) -> list[tuple[int, float]]:
        """Return process id and time of each start of a process."""
        try:
            lines = (self.marks / "starts").read_text().splitlines()
        except FileNotFoundError:
            return []
        words = [line.split() for line in lines]
        return [(int(pid), float(at)) for kind, pid, at in words if kind == name]

    def pid(self, name: str) -> int:
        return self.starts(name)[-1][0]


Make = Callable[..., Site]


@pytest.fixture
def make_site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    """Return a function that makes a site of small processes, which ends after the test."""
    monkeypatch.setenv("PYTHONPATH", f"{CHECKOUT}{os.pathsep}{Path(__file__).parent}")
    with ExitStack() as ends:

        def make(*processes: str | ProcessStart, **more: float) -> Site:
            site = Site(tmp_path, *processes, **more)
            ends.callback(site.end)
            return site

        yield make


def test_a_process_that_died_or_hangs_is_started_again(make_site: Make) -> None:
    """Nothing is left open from its predecessor: a site runs for months."""
    before = _open_files()
    site = make_site("weather", "controller", "pump", silence_s=4.0)
    site.until_ready()
    logs = [site.directory / f"{name}.log" for name in ("weather", "controller", "pump")]
    site.until(lambda: all(log.exists() and log.stat().st_size for log in logs))
    running = _open_files() - before
    killed, died = site.pid("controller"), time.monotonic()
    os.kill(killed, signal.SIGKILL)
    site.until(lambda: site.supervisor.unready == "controller is missing")
    site.until(lambda: site.supervisor.unready == "controller is starting")
    site.until_ready()
    assert site.starts("controller")[-1][1] - died >= 1
    assert site.pid("controller") != killed
    # Relative to what was open: files left by other tests can be closed at any time.
    assert (_open_files() - before).total() == running.total() > 0
    hung, stopped = site.pid("weather"), time.monotonic()
    os.kill(hung, signal.SIGSTOP)
    site.until(lambda: site.supervisor.unready == "weather is missing")
    assert time.monotonic() - stopped > 3.5  # nodes send four heartbeats a second or more
    assert not alive(hung)
    site.until_ready()
    assert site.told == [
        "controller: ended (SIGKILL); starts again in 1 s",
        "weather: had not answered for 4 s: killed; starts again in 1 s",
    ]
    assert not site.stops
    site.end()
    assert not any(alive(pid) for name in ("weather", "controller", "pump")
                   for pid, _ in site.starts(name))
    assert "controller was started" in (site.directory / "controller.log").read_text()


def test_the_drive_is_stopped_for_a_pump_node_that_cannot(make_site: Make) -> None:
    """Once, before the node is restarted; also if it is dead when the site is ended."""
    site = make_site("weather", "pump")
    site.until_ready()
    os.kill(site.pid("pump"), signal.SIGKILL)
    site.until(lambda: len(site.starts("pump")) == 2)
    (stopped,) = site.stops
    assert stopped < site.starts("pump")[1][1]
    site.until_ready()
    os.kill(site.pid("pump"), signal.SIGKILL)
    time.sleep(0.2)
    site.end()
    assert len(site.stops) == 2  # at the end, regardless of what the pump node reports
    assert site.told == [
        "pump: ended (SIGKILL); starts again in 1 s",
        "pump: did not stop the drive; the drive stands",
        "pump: ended (SIGKILL); the drive stands",
    ]


def test_a_silent_pump_node_whose_pump_may_turn_is_killed_sooner(make_site: Make) -> None:
    site = make_site("pump")
    for rests, limit in ((True, 5), (False, 2)):
        (site.marks / "pump-rests").touch()
        if not rests:
            (site.marks / "pump-rests").unlink()
        site.until_ready()
        site.during(0.5)
        os.kill(site.pid("pump"), signal.SIGSTOP)
        site.until(lambda: site.told)
        assert site.told[0].startswith(f"pump: had not answered for {limit} s: killed;")
        starts = len(site.starts("pump"))
        site.until(lambda starts=starts: len(site.starts("pump")) > starts)
        site.until(lambda: len(site.told) == 2)  # the drive is stopped as well
        site.told.clear()


def test_a_process_that_fails_again_and_again_stays_off(
    make_site: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Restarted after 1 and 2 s; the third end is final, and the others live on."""
    monkeypatch.setattr(restarts, "MAX_RESTARTS", 2)
    site = make_site("weather", "fails")
    site.until(lambda: len(site.told) == 3)
    site.during(2.5)
    assert site.told == [
        *(f"fails: ended (exit code 1); starts again in {wait} s" for wait in (1, 2)),
        "fails: ended (exit code 1); it has been restarted 2 times in the last 10 minutes, and "
        "stays off until the site is restarted",
    ]
    assert site.supervisor.unready == "fails is missing"
    assert len(site.starts("fails")) == 3 and alive(site.pid("weather"))


def test_a_drive_that_could_not_be_stopped_is_stopped_again(
    make_site: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once the pump's process stays off, nobody else stops it. The failure is told once."""
    monkeypatch.setattr(restarts, "MAX_RESTARTS", 0)
    monkeypatch.setattr(restarts, "MAX_WAIT_S", 0.5)
    site = make_site("pump")
    site.until_ready()
    site.may_run = True
    os.kill(site.pid("pump"), signal.SIGKILL)
    site.until(lambda: len(site.stops) == 3)
    site.may_run = False
    site.until(lambda: len(site.stops) == 4)
    site.during(1.5)
    assert len(site.stops) == 4
    assert [text.partition(";")[0] for text in site.told] == [
        "pump: ended (SIGKILL)", "pump: did not stop the drive",
    ]


def test_wrong_parameters_are_never_tried_again(make_site: Make) -> None:
    site = make_site("weather", "wrong")
    with pytest.raises(NodeFailed) as failed:
        site.until(lambda: False)
    site.end()
    assert (str(failed.value), failed.value.code) == ("wrong ended (exit code 2)", 2)
    assert failed.value.last_lines.splitlines()[-1] == "  error: parameter x must be a number"
    assert not site.told
    assert not alive(site.pid("weather"))


def test_the_station_is_told_why_it_was_restarted_and_ends_the_site_at_last(
    make_site: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has the alarms node. What it prints on standard output is for people, and in no log."""
    monkeypatch.setattr(restarts, "MAX_RESTARTS", 1)
    site = make_site("weather", "station")
    site.until_ready()
    os.kill(site.pid("station"), signal.SIGKILL)
    site.until(lambda: len(site.starts("station")) == 2)
    site.until_ready()
    assert site.told == [
        "for people: ", "station: ended (SIGKILL); starts again in 1 s",
        "for people: ended (SIGKILL)",
    ]
    os.kill(site.pid("station"), signal.SIGKILL)
    with pytest.raises(NodeFailed, match=r"station ended \(SIGKILL\); it has been restarted 1 "):
        site.until(lambda: False)
    site.end()
    assert (site.directory / "station.log").read_text() == 2 * "station was started\n"
    assert not alive(site.pid("weather"))


def test_on_off_replaces_a_controller_that_is_given_up(
    make_site: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At once if its node cannot run with it any more, otherwise after its restarts.

    It is told why. If it fails likewise, it stays off.
    """
    monkeypatch.setattr(restarts, "MAX_RESTARTS", 1)
    told: dict[str, str] = {}
    marks = tmp_path / "marks"

    def instead(kind: str, why: str) -> tuple[str, str]:
        told[kind] = why
        return "onoff", str(marks)

    kinds = "refuses", "crashes"
    site = make_site(*(process(kind, marks, partial(instead, kind)) for kind in kinds))
    site.until_ready()
    (marks / "turn").touch()
    site.until(lambda: len(site.starts("onoff")) == 2)
    site.until_ready()
    assert told == {
        "refuses": "ended (exit code 2), error: mine.py, line 3: x", "crashes": "ended (SIGSEGV)",
    }
    assert Counter(site.told) == Counter([
        "refuses: ended (exit code 2); given up: starts again in 1 s",
        "crashes: ended (SIGSEGV); starts again in 1 s",
        "crashes: ended (SIGSEGV); given up: starts again in 1 s",
    ])


def _open_files() -> Counter[str]:
    """Return what this process has open, and how often."""
    counts: Counter[str] = Counter()
    for file in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):  # the listing itself
            counts[str(file.readlink())] += 1
    return counts


def test_a_log_that_cannot_be_written_delays_no_one(make_site: Make, tmp_path: Path) -> None:
    """Supervision goes on; what was printed meanwhile is in the log afterwards.

    A supervisor that was itself stopped blames no process: what it missed is not a silence.
    """
    log = tmp_path / "weather.log"
    os.mkfifo(log)  # opening it for writing blocks until someone reads
    site = make_site("weather", "pump", silence_s=3.0)
    site.until_ready()
    site.during(3)
    assert DISK.late
    assert site.longest_step < 2.0
    reading = os.open(log, os.O_RDONLY)
    site.until(lambda: not DISK.late)
    assert os.read(reading, 1000) == b"weather was started\n"
    os.close(reading)
    time.sleep(4.0)  # longer than the limit
    site.during(1)
    site.end()
    assert not site.told


@contextmanager
def few_files_left(number: int) -> Iterator[None]:
    """Let this process open only this many more files."""
    opened = []
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))
    try:
        with suppress(OSError):
            while True:
                opened.append(os.open(os.devnull, os.O_RDONLY))
        for _ in range(number):
            os.close(opened.pop())
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        for file in opened:
            os.close(file)


@pytest.mark.parametrize("files", range(7))
def test_a_start_for_which_there_are_too_few_files(make_site: Make, files: int) -> None:
    """Wherever they run out, it is told, it is tried again, and nothing is left open."""
    site = make_site("station")
    gc.collect()  # close now what earlier tests left open
    before = _open_files()
    with few_files_left(files):
        site.supervisor.update()
    assert _open_files() == before
    (said,) = site.told
    assert said.startswith("station: cannot be started: Too many open files; another attempt")


def test_a_process_that_cannot_be_started_again_for_now(
    make_site: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is reported once and retried."""
    monkeypatch.setattr(restarts, "MAX_WAIT_S", 1.0)
    site = make_site("weather", "pump")
    site.until_ready()
    with few_files_left(1):
        os.kill(site.pid("weather"), signal.SIGKILL)
        site.until(lambda: "cannot be started" in str(site.told))
        site.during(3)
        assert site.supervisor.unready == "weather is missing"
    site.until(lambda: len(site.starts("weather")) == 2)
    site.until_ready()
    site.end()
    assert site.told == [
        "weather: ended (SIGKILL); starts again in 1 s",
        "weather: cannot be started: Too many open files; another attempt is made every 1 s",
    ]
