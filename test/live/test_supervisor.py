"""The supervision of a live site, with real processes: restarts, back-off, limit, drive.

That the pump stops if one of its processes dies or hangs is shown by the fault campaign.
"""

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
    """A supervisor; its processes' ids, one for each start, and what it told.

    Attributes:
        stops: of each stop of the drive how often the pump had been started, and whether the drive
            counted as reached.
    """

    def __init__(self, directory: Path, kinds: tuple[str, str, str]):
        """Begin without a process. See :mod:`small_node` for their kinds."""
        self.pids: dict[str, list[int]] = {name: [] for name in NAMES}
        self.told: list[str] = []
        self.stops: list[tuple[int, bool]] = []
        self.may_run = False  # whether the drive cannot be stopped

        def stop_drive(_pump_node: int, reached: bool) -> tuple[bool, str]:
            self.stops.append((len(self.pids["pump"]), reached))
            return self.may_run, "the drive stands"

        self.processes = [
            SiteProcess(name, ["small_node", kind, str(directory / "reached")], directory, limit)
            for name, kind, limit in zip(NAMES, kinds, (2.0, 5.0, 5.0), strict=True)
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

    def during(self, seconds: float) -> None:
        ended = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > ended)

    def kill(self, name: str, number: signal.Signals = signal.SIGKILL) -> None:
        os.kill(self.pids[name][-1], number)

    def restart(self, name: str, number: signal.Signals = signal.SIGKILL) -> None:
        """Send a signal, and supervise until another process has been started; this one is gone."""
        starts = len(self.pids[name])
        self.kill(name, number)
        self.until(lambda: len(self.pids[name]) > starts)
        assert not alive(self.pids[name][-2])


Make = Callable[..., Site]


@pytest.fixture
def make_site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    """Return a function that makes a site of small processes, which ends after the test."""
    monkeypatch.setenv("PYTHONPATH", f"{CHECKOUT}{os.pathsep}{Path(__file__).parent}")
    monkeypatch.setattr(upkeep, "MAX_WAIT_S", 0.5)
    with ExitStack() as ends:

        def make(*kinds: str, restarts: int = 10) -> Site:
            monkeypatch.setattr(upkeep, "MAX_RESTARTS", restarts)
            site = Site(tmp_path, kinds or NAMES)
            ends.callback(site.end)
            site.until(lambda: "fails" in kinds or "wrong" in kinds or all(
                process.beats for process in site.processes
            ))
            return site

        yield make


def test_before_a_pump_node_is_started_again_the_drive_is_stopped_once(
    make_site: Make, tmp_path: Path
) -> None:
    """Once reached, the drive always counts as reached, also at the end, without a pump node.

    Nothing is left open from a predecessor: a site runs for months.
    """
    site = make_site()
    site.during(0.5)
    running = len(files_of(os.getpid()))
    site.restart("controller")
    site.during(0.5)
    assert len(files_of(os.getpid())) <= running and not site.stops
    site.restart("pump")
    (tmp_path / "reached").touch()
    site.during(1.0)
    (tmp_path / "reached").unlink()
    site.during(0.5)
    site.restart("pump", signal.SIGSTOP)
    site.kill("pump")
    time.sleep(0.2)
    site.end()
    assert site.stops == [(1, False), (2, True), (3, True)]
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
    assert all(alive(site.pids[name][-1]) for name in ("controller", "station"))


def test_a_start_that_the_system_refuses_is_no_failure_of_the_process(make_site: Make) -> None:
    """Without descriptors for longer than the restarts would last, and then started."""
    site = make_site(restarts=1)
    site.kill("station")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    refused = "station: cannot be started: Too many open files; is tried again in 0.5 s"
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
        site.until(lambda: site.told.count(refused) > 3)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    site.until(lambda: len(site.pids["station"]) == 2)


@pytest.mark.parametrize(("lost", "code", "last_line", "starts"), [
    ("wrong", 2, "error: parameter x must be a number", 1),
    ("station", 1, "station was started", 2),
])
def test_wrong_parameters_and_a_station_that_fails_too_often_end_the_site(
    make_site: Make, lost: str, code: int, last_line: str, starts: int
) -> None:
    """Wrong parameters are never tried again. The station, which tells of alarms, knows why it was
    restarted; without it, the site ends.
    """
    site = make_site("pump", "controller", lost, restarts=1)
    if lost == "station":
        site.kill("station")
        site.until(lambda: "for people: ended (SIGKILL)" in site.told)
        site.kill("station")
    with pytest.raises(NodeFailed) as failed:
        site.until(lambda: False)
    site.end()
    assert failed.value.code == code
    assert any(text.endswith(f"\n  {last_line}") for text in site.told)
    assert len(site.pids["station"]) == starts


def test_a_pause_of_the_machine_is_nobodys_silence(make_site: Make) -> None:
    site = make_site()
    for name in NAMES:
        site.kill(name, signal.SIGSTOP)
    time.sleep(3.0)  # longer than the pump node may be silent
    for name in NAMES:
        site.kill(name, signal.SIGCONT)
    site.supervisor.update()
    site.during(1)
    assert all(len(pids) == 1 for pids in site.pids.values())


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
