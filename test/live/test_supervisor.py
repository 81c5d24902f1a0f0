"""The supervision of a live site, with real processes: restarts, back-off, limit, drive."""

from __future__ import annotations

import gc
import json
import os
import re
import resource
import signal
import socket
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
from greenroof_ros.live.site_alarms import SiteAlarms
from greenroof_ros.live.site_run import _StartReport, describe_site
from greenroof_ros.live.supervisor import LiveSupervisor, NodeFailed, NodeSetup, ProcessStart
from greenroof_ros.live.supervisor_socket import SOCKET, SupervisorSocket, read_report

TOO_LONG_S = 60


def process(
    name: str, does: str, marks: Path, instead: Callable[[str], tuple[str, ...]] | None = None
) -> ProcessStart:
    """Return a process of small nodes; see :mod:`small_node`."""
    names = does.split(",") if "," in does else [name]
    nodes = {node: NodeSetup("small_node", {}) for node in names}
    return ProcessStart(name, "small_node", (does, str(marks)), nodes, instead)


class Site:
    """A supervisor, and a record of what its nodes and drive have done."""

    def __init__(self, directory: Path, silence_s: float = 5.0) -> None:
        """Begin without a node."""
        self.directory, self.marks = directory, directory / "marks"
        self.marks.mkdir()
        self.failures: list[tuple[str, str]] = []
        self.stops: list[float] = []
        self.longest_step = 0.0  # of the supervision (s)

        def stop_drive(_pump_node: int, _reached: bool) -> tuple[bool, str]:
            self.stops.append(time.monotonic())
            return False, "the drive stands"

        self.supervisor = LiveSupervisor(
            directory, [], "", stop_drive, lambda *failure: self.failures.append(failure),
            silence_s=silence_s, prepare=dict,
        )
        self._ending = ExitStack()
        self._ending.enter_context(self.supervisor)
        self.end = self._ending.close

    def add(self, *nodes: str) -> None:
        for node in nodes:
            self.supervisor.add(process(node, node, self.marks))

    def until(self, condition: Callable[[], object], seconds: float = TOO_LONG_S) -> None:
        """Supervise until a condition holds."""

        def step() -> bool:
            began = time.monotonic()
            self.supervisor.read_reports()
            self.supervisor.update()
            self.longest_step = max(self.longest_step, time.monotonic() - began)
            return bool(condition())

        wait_for(step, seconds, "what the test waits for")

    def until_ready(self) -> None:
        """Supervise until every node that the pump needs is ready."""
        self.until(lambda: not self.supervisor.unready)

    def during(self, seconds: float) -> None:
        """Supervise for this long (s)."""
        ended = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > ended)

    def starts(self, node: str) -> list[tuple[int, float]]:
        """Return process and time of each start of a node."""
        try:
            lines = (self.marks / "starts").read_text().splitlines()
        except FileNotFoundError:
            return []
        words = [line.split() for line in lines]
        return [(int(pid), float(at)) for kind, pid, at in words if kind == node]

    @property
    def stands(self) -> object:
        return self.supervisor.last.get("pump", {}).get("stands")

    def pid(self, node: str) -> int:
        return self.supervisor.nodes[node].process.pid


@pytest.fixture
def site(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> Iterator[Site]:
    """A site; a test can set its supervisor's limits."""
    monkeypatch.setenv("PYTHONPATH", f"{CHECKOUT}{os.pathsep}{Path(__file__).parent}")
    values = dict(getattr(request, "param", {}))
    monkeypatch.setattr(restarts, "MAX_RESTARTS", values.pop("restarts", 10))
    site = Site(tmp_path, **values)
    yield site
    site.end()


def limits(**limit_values: float) -> pytest.MarkDecorator:
    """Return a mark that sets the limits for a test."""
    return pytest.mark.parametrize("site", [limit_values], indirect=True, ids=[""])


@limits(silence_s=4.0)
def test_a_node_that_died_or_hangs_is_started_again(site: Site) -> None:
    """Nothing is left open from its predecessor: a site runs for months."""
    before = _open_files()
    site.add("weather", "controller", "pump")
    site.until_ready()
    logs = [site.directory / f"{node}.log" for node in ("weather", "controller", "pump")]
    site.until(lambda: all(log.exists() and log.stat().st_size for log in logs))
    nodes = _open_files() - before
    killed, died = site.pid("controller"), time.monotonic()
    os.kill(killed, signal.SIGKILL)
    site.until(lambda: site.supervisor.unready == "controller is missing")
    site.until(lambda: site.supervisor.unready == "controller is starting")
    site.until_ready()
    assert site.starts("controller")[-1][1] - died >= 1
    assert site.pid("controller") != killed
    # Relative to what was open: files left by other tests can be closed at any time.
    assert (_open_files() - before).total() == nodes.total() > 0
    hung, stopped = site.pid("weather"), time.monotonic()
    os.kill(hung, signal.SIGSTOP)
    site.until(lambda: site.supervisor.unready == "weather is missing")
    assert time.monotonic() - stopped > 3.5  # nodes report four times a second or more
    assert not alive(hung)
    site.until_ready()
    assert site.failures == [
        ("controller", "ended (SIGKILL); starts again in 1 s"),
        ("weather", "had not answered for 4 s: killed; starts again in 1 s"),
    ]
    assert not site.stops
    site.end()
    assert not any(alive(pid) for node in ("weather", "controller", "pump")
                   for pid, _ in site.starts(node))
    assert "controller was started" in (site.directory / "controller.log").read_text()


def test_the_drive_is_stopped_for_a_pump_node_that_cannot(site: Site) -> None:
    """Once, before the node is restarted; also if it is dead when the site is ended."""
    site.add("weather", "pump")
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
    assert [reason for _, reason in site.failures] == [
        "ended (SIGKILL); starts again in 1 s",
        "did not stop the drive; the drive stands",
        "ended (SIGKILL); the drive stands",
    ]


def test_a_silent_pump_node_whose_pump_may_turn_is_killed_sooner(site: Site) -> None:
    """What it reports of the pump counts, not its state: an *off* may not reach the drive."""
    (site.marks / "pump-reports").write_text("off: no connection to the drive")
    site.add("pump")
    for stands, limit in ((True, 5), (False, 2)):
        (site.marks / "pump-stands").write_text(json.dumps(stands))
        site.until(lambda stands=stands: site.stands is stands)
        os.kill(site.pid("pump"), signal.SIGSTOP)
        site.until(lambda: site.failures)
        assert site.failures[0][1].startswith(f"had not answered for {limit} s: killed;")
        site.until(lambda: len(site.starts("pump")) == 2)
        site.failures.clear()


@limits(restarts=2)
@pytest.mark.parametrize(
    ("kind", "code", "tried", "reason"),
    [
        ("fails", 1, 2,
            "ended (exit code 1); it has been restarted 2 times in the last 10 minutes, and will "
            "not be restarted again"),
        ("wrong", 2, 0, "ended (exit code 2): parameter x must be a number"),
    ],
)
def test_a_node_that_fails_again_and_again_is_given_up(
    site: Site, kind: str, code: int, tried: int, reason: str
) -> None:
    """Restarted after 1 and 2 s; the third end is final. A wrong parameter is never retried."""
    site.add("weather")
    site.until(lambda: site.starts("weather"))
    site.add(kind)
    with pytest.raises(NodeFailed) as failed:
        site.until(lambda: False)
    site.end()
    assert (str(failed.value), failed.value.code) == (f"node {kind} {reason}", code)
    assert f"{kind} was started" in failed.value.last_lines
    assert site.failures == [
        (kind, f"ended (exit code {code}); starts again in {wait} s") for wait in (1, 2)[:tried]
    ]
    assert not alive(site.starts("weather")[0][0])


@limits(restarts=1)
def test_on_off_replaces_a_controller_that_is_given_up(site: Site) -> None:
    """At once if its node cannot run with it any more, otherwise after its restarts.

    It is told why. If it fails likewise, the site ends.
    """
    told: dict[str, str] = {}

    def instead(kind: str, why: str) -> tuple[str, str]:
        told[kind] = why
        return "onoff", str(site.marks)

    for kind in ("refuses", "crashes"):
        site.supervisor.add(process(kind, kind, site.marks, partial(instead, kind)))
    site.until_ready()
    (site.marks / "turn").touch()
    site.until(lambda: len(site.starts("onoff")) == 2)
    site.until_ready()
    assert told["refuses"] == "ended (exit code 2): mine.py, line 3: x"
    assert re.fullmatch(
        r'ended \(SIGSEGV\), File ".*/ctypes/__init__.py", line \d+ in string_at', told["crashes"]
    )
    assert Counter(site.failures) == Counter([
        ("refuses", f"{told['refuses']}; given up: starts again in 1 s"),
        ("crashes", "ended (SIGSEGV); starts again in 1 s"),
        ("crashes", "ended (SIGSEGV); given up: starts again in 1 s"),
    ])
    os.kill(site.pid("crashes"), signal.SIGKILL)
    site.until(lambda: len(site.starts("onoff")) == 3)
    os.kill(site.pid("crashes"), signal.SIGKILL)
    with pytest.raises(NodeFailed, match="node crashes ended"):
        site.until(lambda: False)


def test_a_process_of_several_nodes(site: Site) -> None:
    """Each is reported by its name; the process is restarted, and counts, once.

    The site does not wait for a gauge that is not ready.
    """
    several = ("cistern_sensor", "roof_sensor", "rain_gauge")
    site.supervisor.add(process("station", ",".join(several), site.marks))
    (site.marks / "roof_sensor-waits").touch()
    (site.marks / "rain_gauge-waits").touch()
    site.until(lambda: site.supervisor.unready == "roof_sensor is starting")
    assert site.supervisor.last.keys() == {*several}
    (site.marks / "roof_sensor-waits").unlink()
    site.until_ready()
    (site.marks / "rain_gauge-waits").unlink()
    site.until(lambda: site.supervisor.last["rain_gauge"]["state"] == "ready")
    os.kill(site.pid("station"), signal.SIGKILL)
    site.until(
        lambda: site.supervisor.unready == "cistern_sensor is missing, roof_sensor is missing"
    )
    site.until_ready()
    assert site.failures == [("station", "ended (SIGKILL); starts again in 1 s")]
    assert "were started" in (site.directory / "station.log").read_text()


def _open_files() -> Counter[str]:
    """Return what this process has open, and how often."""
    counts: Counter[str] = Counter()
    for file in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):  # the listing itself
            counts[str(file.readlink())] += 1
    return counts


@limits(silence_s=3.0)
def test_a_log_that_cannot_be_written_delays_no_one(site: Site) -> None:
    """Supervision goes on; what was printed meanwhile is in the log afterwards.

    A supervisor that was itself stopped blames no node: what it missed is not a silence.
    """
    log = site.directory / "weather.log"
    os.mkfifo(log)  # opening it for writing blocks until someone reads
    site.add("weather", "pump")
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
    assert not site.failures


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
def test_a_start_for_which_there_are_too_few_files(site: Site, files: int) -> None:
    """Wherever they run out, it is an error that can be handled, and nothing is left open."""
    nodes = LiveSupervisor(
        site.directory, [], "", None, print, silence_s=5.0, prepare=dict
    )
    gc.collect()  # close now what earlier tests left open
    before = _open_files()
    with few_files_left(files), pytest.raises(OSError, match="Too many open files"):
        nodes.start(process("weather", "weather", site.marks))
    assert _open_files() == before


def test_a_node_that_cannot_be_started_again_for_now(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is reported once and retried."""
    monkeypatch.setattr(restarts, "MAX_WAIT_S", 1.0)
    site.add("weather", "pump")
    site.until(lambda: site.supervisor.last.keys() == {"weather", "pump"})
    site.until_ready()
    with few_files_left(1):
        os.kill(site.pid("weather"), signal.SIGKILL)
        site.until(lambda: "cannot be started" in str(site.failures))
        site.during(3)
        assert site.supervisor.unready == "weather is missing"
    site.until(lambda: len(site.starts("weather")) == 2)
    site.until_ready()
    site.end()
    assert [reason for _, reason in site.failures] == [
        "ended (SIGKILL); starts again in 1 s",
        "cannot be started: Too many open files; another attempt is made every 1 s",
    ]


def test_a_report_of_another_version_is_none() -> None:
    for report in ([], 7, "ready", {}, {"state": "ready"}, {"state": "ready", "version": "0.9.0"}):
        assert read_report(json.dumps(report).encode()) is None
    for line in (b"", b"{", b"\xff", b"[" * 100_000):
        assert read_report(line) is None


def test_what_systemd_and_the_start_say_of_the_pump(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The state and its reason, of a pump that is held and of one that reports only its drive."""
    held = {"pump_state": "held", "pump_why": "a hold by the page"}
    reports = {"controller": {"command": 0.5}, "pump": {"cistern_level": 2.0, **held}}
    levels = "cistern 2.000 m, roof unknown"
    assert describe_site(reports) == f"{levels}, command 0.500, pump held: a hold by the page"
    alarms = SiteAlarms(tmp_path, "", [process("pump", "pump", tmp_path)], str)
    printed: list[str] = []
    monkeypatch.setattr("greenroof_ros.live.site_run.print_line", printed.append)
    for pump, reason in (held, "held: a hold by the page"), ({}, "unknown"):
        _StartReport().update(alarms.judge, {"pump": {"drive_state": "refused", **pump}}, "")
        assert printed.pop() == f"missing:\n  the pump is kept off: {reason}"


def test_a_report_of_any_size_arrives_whole_and_the_newest_of_each_node_waits(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is larger than the socket's buffer; meanwhile the supervisor is stopped."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        monkeypatch.setenv(SOCKET, str(theirs.fileno()))
        sender = SupervisorSocket()
        numbers = [number / 7 for number in range(100_000)]
        sender.report({"node": "pump", "state": "ready", "numbers": numbers})
        for tick in range(1000):
            for node in ("cistern_sensor", "roof_sensor"):
                sender.report({"node": node, "state": "ready", "tick": tick})
        data = b""
        while not sender.flush(0.0):
            data += os.read(ours.fileno(), 1 << 18)
        theirs.close()
        while part := os.read(ours.fileno(), 1 << 18):
            data += part
    first, *later = map(read_report, data.splitlines())
    assert first is not None and first["numbers"] == numbers
    assert [(report["node"], report["tick"]) for report in later if report] == [
        ("cistern_sensor", 999), ("roof_sensor", 999),
    ]
