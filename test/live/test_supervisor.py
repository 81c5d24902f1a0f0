"""The supervision of a live site, with real processes: restarts, back-off, limit, drive."""

from __future__ import annotations

import os
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from graphs import alive, files_of, wait_for
from places import CHECKOUT

from greenroof_ros.live import upkeep
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
        self.supervisor = LiveSupervisor(
            *self.processes, [], stop_drive, self.told.append, dict
        )
        self._ending = ExitStack()
        self._ending.callback(self.supervisor.end)

    def end(self) -> None:
        """End all processes; none may be left."""
        self._ending.close()
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

    def kill(self, name: str, number: signal.Signals = signal.SIGKILL) -> tuple[int, float]:
        """Send a signal to a process, and return its process id and the time."""
        os.kill(self.pids[name][-1], number)
        return self.pids[name][-1], time.monotonic()

    def restart(self, name: str, number: signal.Signals = signal.SIGKILL) -> tuple[int, float]:
        """Send a signal, and supervise until the process has been started once more."""
        starts, sent = len(self.pids[name]), self.kill(name, number)
        self.until(lambda: len(self.pids[name]) > starts)
        return sent

    def said(self) -> list[str]:
        """Return what was told, but for what the processes themselves print for people."""
        return [text for text in self.told if not text.startswith("for people")]


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
    site = make_site(silence_s=4.0)
    site.until_ready()
    site.during(0.5)
    running = len(files_of(os.getpid()))
    _, died = site.restart("controller")
    assert time.monotonic() - died >= 1
    site.during(0.5)
    assert len(files_of(os.getpid())) <= running
    hung, stopped = site.restart("station", signal.SIGSTOP)
    assert time.monotonic() - stopped > 3.5 and not alive(hung)
    assert not site.stops
    site.end()
    assert site.said() == [
        "controller: ended (SIGKILL); starts again in 1 s",
        "station: did not respond: killed; starts again in 1 s",
        "pump: ended (exit code 0); the drive stands",
    ]
    assert "controller was started" in (tmp_path / "controller.log").read_text()


def test_the_drive_is_stopped_for_a_pump_node_that_cannot(
    make_site: Make, tmp_path: Path
) -> None:
    """Once, before the node is restarted, dead or silent; also if it is dead at the end.

    Once the drive was reached, it always counts as reached.
    """
    site = make_site()
    site.until_ready()
    site.restart("pump")
    assert [stop[1:] for stop in site.stops] == [(1, False)]
    (tmp_path / "reached").touch()
    site.during(1.0)
    (tmp_path / "reached").unlink()
    site.during(0.5)
    hung, began = site.restart("pump", signal.SIGSTOP)
    assert site.stops[1][1:] == (2, True) and not alive(hung)
    assert 1.5 < site.stops[1][0] - began < 4.5
    site.kill("pump")
    time.sleep(0.2)
    site.end()
    assert len(site.stops) == 3  # at the end, regardless of what the pump node reports
    assert site.said() == [
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
    site.until(lambda: len(site.pids["pump"]) == 2 and len(site.stops) >= 5)
    site.may_run = False
    tried = len(site.stops)
    site.during(2.0)
    assert tried <= len(site.stops) <= tried + 1 and len(site.pids["pump"]) == 2
    assert site.said()[0] == "pump: ended (exit code 1); starts again in 0.5 s"
    assert "has failed too often, and stays off until the site is restarted" in site.said()[2]
    assert all(alive(site.pids[name][-1]) for name in ("controller", "station"))


def test_a_start_that_the_system_refuses_is_no_failure_of_the_process(
    make_site: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without descriptors for longer than the restarts would last, and then started."""
    monkeypatch.setattr(upkeep, "MAX_RESTARTS", 1)
    monkeypatch.setattr(upkeep, "MAX_WAIT_S", 0.2)
    site = make_site()
    site.until_ready()
    site.kill("station")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    refused = "station: cannot be started: Too many open files; is tried again in 0.2 s"
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
        site.until(lambda: site.told.count(refused) > 5)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    site.until(lambda: len(site.pids["station"]) == 2)


@pytest.mark.parametrize(("lost", "why", "code", "last_line", "starts"), [
    ("wrong", "exit code 2", 2, "error: parameter x must be a number", 1),
    ("station", "SIGKILL", 1, "station was started", 2),
])
def test_what_ends_the_site(
    make_site: Make, monkeypatch: pytest.MonkeyPatch, lost: str, why: str, code: int,
    last_line: str, starts: int,
) -> None:
    """Wrong parameters are never tried again. The station, which tells of alarms, knows why it was
    restarted; without it, the site ends.
    """
    monkeypatch.setattr(upkeep, "MAX_RESTARTS", 1)
    site = make_site("pump", "controller", lost)
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
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(tmp_path / "notify"))
        code = "from greenroof_ros.live.site_run import notify\n" \
            "for _ in range(10_000): notify('WATCHDOG=1')"
        environment = {"NOTIFY_SOCKET": str(tmp_path / "notify")}
        command = [sys.executable, "-c", code]
        subprocess.run(command, env=environment, timeout=300, check=True, cwd=CHECKOUT)


@pytest.mark.parametrize(("tau", "decides", "silent"), [(1.0, 3.0, 5.0), (8.0, 8.0, 10.0)])
def test_a_controller_that_may_still_decide_is_not_killed(
    tau: float, decides: float, silent: float
) -> None:
    assert (upkeep.deciding_limit(tau), upkeep.silence_limit(tau)) == (decides, silent)
