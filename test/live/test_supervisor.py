"""The supervision of a live site, with real processes: restarts, back-off, limit, drive."""

from __future__ import annotations

import os
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from graphs import alive, wait_for
from places import CHECKOUT

from greenroof_ros.base.disk import DISK
from greenroof_ros.live import upkeep
from greenroof_ros.live.supervisor import LiveSupervisor, NodeFailed, SiteProcess

TOO_LONG_S = 60
NAMES = ("pump", "controller", "station")


class Site:
    """A supervisor, and a record of what its processes and drive have done."""

    def __init__(self, directory: Path, kinds: tuple[str, str, str], silence_s: float):
        """Begin without a process. See :mod:`small_node` for their kinds."""
        self.marks = directory / "marks"
        self.marks.mkdir(exist_ok=True)
        self.told: list[str] = []
        self.stops: list[tuple[float, bool]] = []
        self.may_run = False  # whether the drive cannot be stopped
        self.longest_step = 0.0  # of the supervision (s)

        def stop_drive(_pump_node: int, reached: bool) -> tuple[bool, str]:
            self.stops.append((time.monotonic(), reached))
            return self.may_run, "the drive stands"

        self.supervisor = LiveSupervisor(
            *(
                SiteProcess(
                    name, ["small_node", kind, str(self.marks)], directory,
                    2.0 if name == "pump" else silence_s,
                ) for name, kind in zip(NAMES, kinds, strict=True)
            ),
            [], stop_drive, self._tell, dict,
        )
        self._ending = ExitStack()
        self._ending.callback(self.supervisor.end)
        self.end = self._ending.close

    def _tell(self, text: str) -> None:
        if not text.startswith("for people"):
            self.told.append(text)

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
        self.until(lambda: self.supervisor.ready)

    def until_restarted(self, kind: str) -> None:
        """Supervise until a process of this kind has been started once more, and runs."""
        starts = len(self.starts(kind))
        self.until(lambda: len(self.starts(kind)) > starts)

    def during(self, seconds: float) -> None:
        ended = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > ended)

    def starts(self, kind: str) -> list[tuple[int, float]]:
        """Return process id and time of each start of a process of this kind."""
        with suppress(FileNotFoundError):
            words = [line.split() for line in (self.marks / "starts").read_text().splitlines()]
            return [(int(pid), float(at)) for name, pid, at in words if name == kind]
        return []

    def pid(self, kind: str) -> int:
        return self.starts(kind)[-1][0]


Make = Callable[..., Site]


@pytest.fixture
def make_site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    """Return a function that makes a site of small processes, which ends after the test."""
    monkeypatch.setenv("PYTHONPATH", f"{CHECKOUT}{os.pathsep}{Path(__file__).parent}")
    with ExitStack() as ends:

        def make(*kinds: str, silence_s: float = 5.0) -> Site:
            site = Site(tmp_path, kinds or NAMES, silence_s)
            ends.callback(site.end)
            return site

        yield make


def test_a_process_that_died_or_hangs_is_started_again(make_site: Make, tmp_path: Path) -> None:
    """Nothing is left open from its predecessor: a site runs for months."""
    before = _open_files()
    site = make_site(silence_s=4.0)
    site.until_ready()
    site.during(0.5)
    running = _open_files() - before
    killed, died = site.pid("controller"), time.monotonic()
    os.kill(killed, signal.SIGKILL)
    site.until_restarted("controller")
    site.during(0.5)
    assert site.starts("controller")[-1][1] - died >= 1
    # Relative to what was open: files left by other tests can be closed at any time.
    assert (_open_files() - before).total() == running.total() > 0
    hung, stopped = site.pid("station"), time.monotonic()
    os.kill(hung, signal.SIGSTOP)
    site.until_restarted("station")
    assert time.monotonic() - stopped > 3.5 and not alive(hung)
    assert site.told == [
        "controller: ended (SIGKILL); starts again in 1 s",
        "station: did not respond: killed; starts again in 1 s",
    ]
    assert not site.stops
    site.end()
    assert not any(alive(pid) for name in NAMES for pid, _ in site.starts(name))
    assert "controller was started" in (tmp_path / "controller.log").read_text()


def test_the_drive_is_stopped_for_a_pump_node_that_cannot(make_site: Make) -> None:
    """Once, before the node is restarted, dead or silent; also if it is dead at the end.

    Once the drive was reached, it always counts as reached.
    """
    site = make_site()
    site.until_ready()
    os.kill(site.pid("pump"), signal.SIGKILL)
    site.until_restarted("pump")
    ((stopped, reached),) = site.stops
    assert stopped < site.starts("pump")[1][1] and not reached
    (site.marks / "reached").touch()
    site.during(0.5)
    (site.marks / "reached").unlink()
    site.during(0.5)
    hung, began = site.pid("pump"), time.monotonic()
    os.kill(hung, signal.SIGSTOP)
    site.until(lambda: len(site.stops) == 2)
    assert 1.5 < site.stops[1][0] - began < 4.5 and site.stops[1][1] and not alive(hung)
    site.until_restarted("pump")
    os.kill(site.pid("pump"), signal.SIGKILL)
    time.sleep(0.2)
    site.end()
    assert len(site.stops) == 3  # at the end, regardless of what the pump node reports
    assert site.told == [
        "pump: ended (SIGKILL); starts again in 1 s",
        "pump: did not stop the drive; the drive stands",
        "pump: did not respond: killed; starts again in 2 s",
        "pump: did not stop the drive; the drive stands",
        "pump: ended (SIGKILL); the drive stands",
    ]


def test_a_pump_node_that_fails_again_and_again_stays_off(
    make_site: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The others live on. The drive is stopped until that succeeds, as nobody else stops it."""
    monkeypatch.setattr(upkeep, "MAX_RESTARTS", 1)
    monkeypatch.setattr(upkeep, "MAX_WAIT_S", 0.5)
    site = make_site("fails", "controller", "station")
    site.may_run = True
    site.until(lambda: len(site.starts("fails")) == 2 and len(site.stops) >= 5)
    site.may_run = False
    tried = len(site.stops)
    site.during(2.0)
    assert tried <= len(site.stops) <= tried + 1 and len(site.starts("fails")) == 2
    assert site.told[0] == "pump: ended (exit code 1); starts again in 0.5 s"
    assert (
        "pump: ended (exit code 1); has failed too often, and stays off until the site is "
        "restarted"
    ) in site.told
    assert alive(site.pid("controller")) and alive(site.pid("station"))


def test_wrong_parameters_are_never_tried_again(make_site: Make) -> None:
    site = make_site("pump", "wrong", "station")
    with pytest.raises(NodeFailed) as failed:
        site.until(lambda: False)
    site.end()
    assert (str(failed.value), failed.value.code) == ("controller ended (exit code 2)", 2)
    assert site.told[0].splitlines()[-1] == "  error: parameter x must be a number"
    assert not any(alive(pid) for name in NAMES for pid, _ in site.starts(name))


def test_without_the_station_the_site_ends(
    make_site: Make, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """It has the alarms node, and is told why it was restarted."""
    monkeypatch.setattr(upkeep, "MAX_RESTARTS", 1)
    site = make_site()
    heard: list[str] = []
    monkeypatch.setattr(site.supervisor, "_tell", heard.append)
    site.until_ready()
    os.kill(site.pid("station"), signal.SIGKILL)
    site.until(lambda: "for people: ended (SIGKILL)" in heard)
    os.kill(site.pid("station"), signal.SIGKILL)
    with pytest.raises(NodeFailed, match=r"station ended \(SIGKILL\)"):
        site.until(lambda: False)
    site.end()
    assert (tmp_path / "station.log").read_text() == 2 * "station was started\n"
    assert not any(alive(pid) for name in NAMES for pid, _ in site.starts(name))


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
    log = tmp_path / "station.log"
    os.mkfifo(log)  # opening it for writing blocks until someone reads
    site = make_site(silence_s=3.0)
    site.until_ready()
    site.during(3)
    assert DISK.late
    assert site.longest_step < 2.0
    reading = os.open(log, os.O_RDONLY)
    site.until(lambda: not DISK.late)
    assert os.read(reading, 1000) == b"station was started\n"
    os.close(reading)
    time.sleep(4.0)  # longer than the limit
    site.during(1)
    site.end()
    assert not site.told
