"""The supervision of a live site, with real processes: restarts, back-off, limit, drive."""

from __future__ import annotations

import math
import os
import resource
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from graphs import alive, files_of, wait_for
from places import CHECKOUT

from greenroof_ros.live import upkeep
from greenroof_ros.live.live_site import notify
from greenroof_ros.live.supervisor import LiveSupervisor, NodeFailed, SiteProcess

NAMES = ("pump", "controller", "station")


class Site:
    """A supervisor, and a record of what its processes and drive have done.

    Attributes:
        pids: the process ids of each process, one for each start.
        stops: of each stop of the drive the time, how often the pump had been started, and whether
            the drive counted as reached.
    """

    def __init__(self, directory: Path, kinds: tuple[str, str, str], silence_s: float):
        """Begin without a process. See :mod:`small_node` for their kinds."""
        self.pids: dict[str, list[int]] = {name: [] for name in NAMES}
        self.told: list[str] = []
        self.stops: list[tuple[float, int, bool]] = []
        self.may_run = False  # whether the drive cannot be stopped

        def stop_drive(_pump_node: int, reached: bool) -> tuple[bool, str]:
            self.stops.append((time.monotonic(), len(self.pids["pump"]), reached))
            return self.may_run, "the drive stands"

        self.processes = [
            SiteProcess(name, ["small_node", kind, str(directory / "reached")], directory, limit)
            for name, kind, limit in zip(NAMES, kinds, (2.0, silence_s, silence_s), strict=True)
        ]
        self.supervisor = LiveSupervisor(self.processes, [], stop_drive, self.told.append, dict)

    def end(self) -> None:
        """End all processes; none may be left."""
        self.supervisor.end()
        assert not any(alive(pid) for pids in self.pids.values() for pid in pids)

    def until(self, condition: Callable[[], object]) -> None:
        """Supervise until a condition holds."""

        def step() -> bool:
            self.supervisor.read()
            self.supervisor.update()
            for process in self.processes:
                if process.pid and process.pid not in self.pids[process.name]:
                    self.pids[process.name].append(process.pid)
            return bool(condition())

        wait_for(step, 60, "what the test waits for")

    def until_ready(self) -> None:
        self.until(lambda: all(process.beats for process in self.processes))

    def during(self, seconds: float) -> None:
        ended = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > ended)

    def kill(self, name: str, number: signal.Signals = signal.SIGKILL) -> None:
        os.kill(self.pids[name][-1], number)

    def restart(self, name: str, number: signal.Signals = signal.SIGKILL) -> float:
        """Send a signal, and supervise until the process has been started once more.

        Return how long that took (s); its predecessor must be gone.
        """
        starts, began = len(self.pids[name]), time.monotonic()
        self.kill(name, number)
        self.until(lambda: len(self.pids[name]) > starts)
        assert not alive(self.pids[name][-2])
        return time.monotonic() - began

    def said(self) -> list[str]:
        """Return what was told, but for what the processes themselves print for people."""
        return [text for text in self.told if not text.startswith("for people")]


Make = Callable[..., Site]


@pytest.fixture
def make_site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    """Return a function that makes a site of small processes, which ends after the test."""
    monkeypatch.setenv("PYTHONPATH", f"{CHECKOUT}{os.pathsep}{Path(__file__).parent}")
    monkeypatch.setattr(upkeep, "MAX_WAIT_S", 0.5)
    with ExitStack() as ends:

        def make(*kinds: str, silence_s: float = 5.0, restarts: int = 10) -> Site:
            monkeypatch.setattr(upkeep, "MAX_RESTARTS", restarts)
            site = Site(tmp_path, kinds or NAMES, silence_s)
            ends.callback(site.end)
            return site

        yield make


def test_a_process_that_died_or_hangs_is_started_again(make_site: Make, tmp_path: Path) -> None:
    """Nothing is left open from its predecessor: a site runs for months.

    For the pump node, the drive is stopped first, once; once reached, it always counts as reached.
    A pump node that is dead at the end stops no drive.
    """
    site = make_site(silence_s=4.0)
    site.until_ready()
    site.during(0.5)
    running = len(files_of(os.getpid()))
    assert site.restart("controller") >= 0.5
    site.during(0.5)
    assert len(files_of(os.getpid())) <= running
    assert site.restart("station", signal.SIGSTOP) > 3.5
    assert not site.stops
    site.restart("pump")
    assert [stop[1:] for stop in site.stops] == [(1, False)]
    (tmp_path / "reached").touch()
    site.during(1.0)
    (tmp_path / "reached").unlink()
    site.during(0.5)
    began = time.monotonic()
    site.restart("pump", signal.SIGSTOP)
    assert site.stops[1][1:] == (2, True)
    assert 1.5 < site.stops[1][0] - began < 4.5
    site.kill("pump")
    time.sleep(0.2)
    site.end()
    assert len(site.stops) == 3  # at the end, regardless of what the pump node reports
    assert site.said() == [
        "controller: ended (SIGKILL); starts again in 0.5 s",
        "station: did not respond: killed; starts again in 0.5 s",
        "pump: ended (SIGKILL); starts again in 0.5 s",
        "pump: did not stop the drive; the drive stands",
        "pump: did not respond: killed; starts again in 0.5 s",
        "pump: did not stop the drive; the drive stands",
        "pump: ended (SIGKILL); the drive stands",
    ]
    assert "controller was started" in (tmp_path / "controller.log").read_text()


def test_a_pump_node_that_fails_again_and_again_stays_off(make_site: Make) -> None:
    """The others live on. The drive is stopped until that succeeds, as nobody else stops it."""
    site = make_site("fails", "controller", "station", restarts=1)
    site.may_run = True
    site.until(lambda: len(site.pids["pump"]) == 2 and len(site.stops) >= 5)
    site.may_run = False
    tried = len(site.stops)
    site.during(2.0)
    assert tried <= len(site.stops) <= tried + 1 and len(site.pids["pump"]) == 2
    assert "has failed too often, and stays off until the site is restarted" in site.said()[2]
    assert all(alive(site.pids[name][-1]) for name in ("controller", "station"))


def test_a_start_that_the_system_refuses_is_no_failure_of_the_process(make_site: Make) -> None:
    """Without descriptors for longer than the restarts would last, and then started."""
    site = make_site(restarts=1)
    site.until_ready()
    site.kill("station")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    refused = "station: cannot be started: Too many open files; is tried again in 0.5 s"
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
        site.until(lambda: site.told.count(refused) > 3)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    site.until(lambda: len(site.pids["station"]) == 2)


@pytest.mark.parametrize(("lost", "why", "code", "last_line", "starts"), [
    ("wrong", "exit code 2", 2, "error: parameter x must be a number", 1),
    ("station", "SIGKILL", 1, "station was started", 2),
])
def test_what_ends_the_site(
    make_site: Make, lost: str, why: str, code: int, last_line: str, starts: int
) -> None:
    """Wrong parameters are never tried again. The station, which tells of alarms, knows why it was
    restarted; without it, the site ends.
    """
    site = make_site("pump", "controller", lost, restarts=1)
    if lost == "station":
        site.until_ready()
        site.kill("station")
        site.until(lambda: "for people: ended (SIGKILL)" in site.told)
        site.kill("station")
    with pytest.raises(NodeFailed) as failed:
        site.until(lambda: False)
    site.end()
    assert (str(failed.value), failed.value.code) == (f"station ended ({why})", code)
    assert any(text.endswith(f"\n  {last_line}") for text in site.told)
    assert len(site.pids["station"]) == starts


def test_a_pause_of_the_machine_is_nobodys_silence(make_site: Make) -> None:
    site = make_site()
    site.until_ready()
    for name in NAMES:
        site.kill(name, signal.SIGSTOP)
    time.sleep(3.0)  # longer than the pump node may be silent
    for name in NAMES:
        site.kill(name, signal.SIGCONT)
    site.supervisor.update()
    site.during(1)
    assert not site.said()


def test_who_does_not_read_stops_no_process(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Neither bringup its nodes, nor systemd bringup; the time limit is the test."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    monkeypatch.setenv(upkeep.PIPE, str(writing))
    for reached in (False, True):
        upkeep.send_beat(reached)
        assert os.read(reading, 10) == bytes([reached])
    for _ in range(100_000):
        upkeep.send_beat(True)
    os.close(reading)
    upkeep.send_beat(True)
    os.close(writing)
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(tmp_path / "notify"))
        for _ in range(10_000):
            notify("WATCHDOG=1")


def test_the_waits_before_restarts_grow_and_the_eleventh_in_ten_minutes_is_none() -> None:
    restarts, due = upkeep.Restarts(), []
    for now in [*[100.0] * 11, 701.0]:
        restarts.postpone(now)
        due.append(restarts.due - now)
    assert due == [1, 2, 4, 8, *[10] * 6, math.inf, 1]


@pytest.mark.parametrize(("tau", "decides", "silent"), [(1.0, 3.0, 5.0), (8.0, 8.0, 10.0)])
def test_a_controller_that_may_still_decide_is_not_killed(
    tau: float, decides: float, silent: float
) -> None:
    assert (upkeep.deciding_limit(tau), upkeep.silence_limit(tau)) == (decides, silent)
