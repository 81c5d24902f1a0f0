"""Nodes of a live graph, with sensors that the test plays: every rule of an input, and the weather.

A tick is 0.2 s here, and the limits are of seconds, so that a failure and its end take few.
"""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import sys
import time
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import pytest
from graphs import environment, free_ports
from places import CONFIG

rclpy = pytest.importorskip("rclpy", reason="nodes need ROS 2")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from rcl_interfaces.srv import SetParameters  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from std_msgs.msg import Float64, Float64MultiArray  # noqa: E402
from test_nodes import Observer, observer, offered, qos  # noqa: E402, F401

from greenroof_ros.common.files import read_yaml  # noqa: E402

TAU = 0.2
# What a busy machine may take (s). That each bound holds, test_input_rules.py shows by a clock of
# its own, and so does the campaign of faults.
LATE = 60.0
OK, WARN, ERROR = b"\x00", b"\x01", b"\x02"


class Site:
    """The sensors and the weather of a site, and what is heard from the node under test."""

    def __init__(self, watcher: Observer) -> None:
        """Publish nothing yet."""
        self.watcher = watcher
        self.node = watcher.node
        self.heard: dict[str, list[tuple[float, Any]]] = {}
        self.diagnoses: dict[str, tuple[bytes, str]] = {}
        self.said: list[str] = []
        self.values: dict[str, Any] = {}
        self._publishers: dict[str, Any] = {}
        self._next = time.monotonic()
        self.node.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, qos("/diagnostics")
        )

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.diagnoses[status.name] = (status.level, status.message)
            self.said.append(status.message)

    def listen(self, topic: str, kind: Any = Float64) -> list[tuple[float, Any]]:
        """Note when each value of a topic comes."""
        values = self.heard.setdefault(topic, [])
        self.node.create_subscription(
            kind, topic, lambda message: values.append((time.monotonic(), message.data)), qos(topic)
        )
        return values

    def publisher(self, topic: str, node: Node | None = None) -> Any:
        kind = Float64MultiArray if topic.startswith("/forecast") else Float64
        return (node or self.node).create_publisher(kind, topic, offered(topic))

    def play(self) -> None:
        """Publish the present values, ten times a second; a value may be a function of time."""
        if time.monotonic() < self._next:
            return
        self._next = time.monotonic() + 0.1
        for topic, value in self.values.items():
            if topic not in self._publishers:
                self._publishers[topic] = self.publisher(topic)
            data = value(time.monotonic()) if callable(value) else value
            kind = Float64MultiArray if topic.startswith("/forecast") else Float64
            self._publishers[topic].publish(kind(data=data))

    def until(self, condition: Callable[[], Any], seconds: float, what: str) -> None:
        """Play until a condition holds."""

        def played() -> Any:
            self.play()
            return condition()

        self.watcher.until(played, seconds, f"{what} ({self.diagnoses})")

    def during(self, seconds: float) -> None:
        """Play for so long; a moment in which the machine stands still counts for 0.1 s."""
        played = 0.0
        while played < seconds:
            began = time.monotonic()
            self.play()
            self.watcher.executor.spin_once(timeout_sec=0.05)
            played += min(time.monotonic() - began, 0.1)

    def says(self, part: str, level: bytes, *words: str) -> Callable[[], bool]:
        """Return whether a part is at a level, with some words."""

        def said() -> bool:
            found = self.diagnoses.get(part)
            return found is not None and found[0] == level and all(w in found[1] for w in words)

        return said


@pytest.fixture
def site(observer: Observer) -> Site:  # noqa: F811
    return Site(observer)


def start_live(
    domain: int, cwd: Path, command: str, **parameters: object
) -> subprocess.Popen[bytes]:
    """Start a node with a tick of 0.2 s in a live graph."""
    file = cwd / "site.yaml"
    file.write_text((CONFIG / "site.yaml").read_text().replace("tau: 1.0 ", f"tau: {TAU} "))
    given = {"live": "true", "site_file": file, **parameters}
    return subprocess.Popen(
        [
            sys.executable, "-m", *f"greenroof_ros.nodes.{command}".split(), "--ros-args",
            *(word for name, value in given.items() for word in ("-p", f"{name}:={value}")),
        ],
        cwd=cwd, env=environment(domain),
    )


@contextmanager
def live_node(
    domain: int, cwd: Path, command: str, **parameters: object
) -> Iterator[subprocess.Popen[bytes]]:
    """Start such a node, and end it; it must end well."""
    process = start_live(domain, cwd, command, **parameters)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGCONT)
        process.send_signal(signal.SIGINT)
        # The kernel ends a node whose middleware takes long to go, as on a busy machine.
        assert process.wait(300) in (0, -signal.SIGALRM)


def dry_site(site: Site) -> list[tuple[float, Any]]:
    """Let the site have a dry roof and enough water, both moving, and return the commands."""
    began = time.monotonic()
    site.values = {
        "/cistern/level": lambda now: 2.5 - 1.6e-4 * (now - began),
        "/roof/level": lambda now: 0.02 + 1e-5 * (now - began),
        "/weather/frost": 0.0,
        "/forecast/precipitation": [0.0] * 10,
        "/forecast/evapotranspiration": [1e-6] * 10,
    }
    return site.listen("/pump/command")


def newest(values: list[tuple[float, Any]]) -> Any:
    return values[-1][1] if values else None


# Lets a process find that the machine was suspended for an hour while there is a file *suspended*.
# A machine that is suspended for an hour: between two decisions of a node, or in the middle of one,
# before and after which it looks how long it was suspended.
SUSPENDED = """
import sys
import time
from pathlib import Path
awake, slept, looks = time.clock_gettime, 0.0, 0
def clock_gettime(clock):
    global slept, looks
    if clock != time.CLOCK_BOOTTIME:
        return awake(clock)
    looks += sys._getframe(2).f_code.co_name == "suspended_time"
    if Path("suspended").exists() or (Path("suspended_in_a_decision").exists() and looks % 2 == 0
            and sys._getframe(2).f_code.co_name == "suspended_time"):
        slept = 3600.0
    return awake(clock) + slept
time.clock_gettime = clock_gettime
"""


def other_node(site: Site) -> Node:
    return Node("intruder", context=site.watcher.context, start_parameter_services=False)


def test_each_rule_of_an_input_stops_the_pump(domain: int, tmp_path: Path, site: Site) -> None:
    """Command 0 within the bound, the input and the rule on /diagnostics, and good again."""
    commands = dry_site(site)
    good = dict(site.values)
    recovery, limit = 1.0, 1.5
    base = good["/roof/level"]

    def expect_stop(*words: str) -> None:
        site.until(lambda: newest(commands) == 0.0, LATE, f"stop: {words}")
        site.until(site.says("/onoff: inputs", ERROR, *words), LATE, f"{words}")

    def expect_recovery(mended: float) -> None:
        site.until(lambda: newest(commands) == 0.5, LATE, "recovery")
        assert commands[-1][0] - mended > recovery - 0.1  # from the first good value on
        site.until(site.says("/onoff: inputs", OK), LATE, "all well")

    def expect_none(rule: str) -> None:
        # A command 0 for another reason, as when this process stood still, passes.
        assert not [text for text in site.said if rule in text]
        site.until(lambda: newest(commands) == 0.5, LATE, "a command")

    with live_node(
        domain, tmp_path, "controller --controller onoff", fraction=0.5, level_limit=limit,
        recovery_time=recovery, frozen_movement=3e-4, jump_tolerance=0.02,
    ):
        site.until(lambda: newest(commands) == 0.5, LATE, "a command")
        for bad in (math.nan, 1e9):
            site.values["/roof/level"] = bad
            expect_stop("/roof/level was refused", "0 to 100 m")
            mended = time.monotonic()
            site.values["/roof/level"] = base
            expect_recovery(mended)

        del site.values["/cistern/level"]
        expect_stop("/cistern/level is older than 1.5 s (level_limit)")
        mended = time.monotonic()
        site.values = dict(good)
        expect_recovery(mended)

        site.values["/roof/level"] = lambda now: base(now) + 0.012
        site.during(3)
        expect_none("jumped")  # less than the tolerance: that is no jump
        jumped = time.monotonic()
        site.values["/roof/level"] = lambda now: base(now) - 0.015
        site.until(lambda: newest(commands) == 0.0, LATE, "stop by a jump")
        site.until(site.says("/onoff: inputs", WARN, "/roof/level jumped"), LATE, "the jump")
        expect_recovery(jumped)
        site.values["/roof/level"] = lambda now: base(now) - 0.005
        site.during(0.5)

        # 0.5 of the pumps' flow is 0.16 mm/s of the cistern: 0.3 mm in 1.8 s.
        site.values["/cistern/level"] = good["/cistern/level"](time.monotonic())
        expect_stop("/cistern/level is frozen")
        site.during(2)
        assert newest(commands) == 0.0
        mended = time.monotonic()
        site.values["/cistern/level"] = good["/cistern/level"]
        expect_recovery(mended)

        intruder = other_node(site)
        second = site.publisher("/roof/level", intruder)
        expect_stop("/roof/level has 2 publishers (intruder, observer)")
        second.publish(Float64(data=0.03))
        site.during(1)
        assert newest(commands) == 0.0
        mended = time.monotonic()
        intruder.destroy_node()
        expect_recovery(mended)

        # The flow that is heard counts, not the command: a held pump freezes no level.
        site.values["/pump/flow"] = 0.0
        site.during(2)
        site.said.clear()
        site.values["/cistern/level"] = good["/cistern/level"](time.monotonic())
        site.during(4)
        expect_none("frozen")
        # A tick is a tick: none twice, and none left out but where the machine is busy.
        times = [now for now, _ in commands]
        assert len(times) < 1.1 * (times[-1] - times[0]) / TAU + 10
        gaps = [after - before for before, after in pairwise(times)]
        assert median(gaps) == pytest.approx(TAU, rel=0.5)


FORECASTS = ("/forecast/precipitation", "/forecast/evapotranspiration")


def test_onoff_needs_no_forecast(domain: int, tmp_path: Path, site: Site) -> None:
    """It is as well without; with one that is refused, too."""
    commands = dry_site(site)
    for name in FORECASTS:
        del site.values[name]
    with live_node(domain, tmp_path, "controller --controller onoff", recovery_time=0.2):
        site.until(lambda: newest(commands) == 1.0, LATE, "a command")
        site.until(site.says("/onoff: inputs", OK), LATE, "all well")
        site.values.update(dict.fromkeys(FORECASTS, [math.nan] * 10))
        site.during(2)
        assert newest(commands) == 1.0
        assert site.says("/onoff: inputs", OK)()
        assert "/onoff: forecast" not in site.diagnoses


# What a forecast of rain may be, and what is said of it: of another length, with a value far ahead
# that cannot be, and none at all.
BAD_FORECASTS: dict[str, tuple[list[float] | None, str]] = {
    "empty": ([], "was refused"),
    "short": ([0.0] * 9, "was refused"),
    "long": ([0.0] * 2000, "was refused"),
    "not finite": ([*[0.0] * 9, math.nan], "was refused: nan"),
    "a flood": ([1.0] * 10, "was refused: 1.0"),
    "none": (None, "is older than 1 s (forecast_limit)"),
}


def test_onoff_commands_without_a_forecast(domain: int, tmp_path: Path, site: Site) -> None:
    """And says so, with reason and time; a level or frost that is not known stops it as ever."""
    commands = dry_site(site)
    good = dict(site.values)
    rain = "/forecast/precipitation"
    with live_node(
        domain, tmp_path, "controller --controller mpc", max_command=0.4, recovery_time=0.2,
        forecast_limit=1.0, level_limit=1.5, jump_tolerance=1.0,
    ):
        for what, (bad, why) in BAD_FORECASTS.items():
            site.until(lambda: 0 < (newest(commands) or 0) <= 0.4, LATE, "a command of mpc")
            site.until(site.says("/mpc: forecast", OK), LATE, "all well")
            began = datetime.now(UTC).replace(microsecond=0)
            without = {name: value for name, value in good.items() if name != rain}
            site.values = without if bad is None else {**without, rain: bad}
            site.until(lambda: newest(commands) == 1.0, LATE, f"on/off, {what}")
            said = site.says("/mpc: forecast", WARN, "on/off commands since ", f"{rain} {why}")
            site.until(said, LATE, what)
            since = re.search(r"since (\S+ \S+), ", site.diagnoses["/mpc: forecast"][1])
            assert since and began <= datetime.fromisoformat(since[1]) <= datetime.now(UTC)
            # Command after command, also where the controller is asked again and refuses again.
            asked = len(commands)
            site.during(1)
            assert {value for _, value in commands[asked:]} == {1.0}
            assert site.says("/mpc: inputs", OK)()
            if bad is not None:
                site.values = dict(good)
        for change in (
            {"/roof/level": 0.05}, {"/roof/level": math.nan}, {"/cistern/level": 0.5},
            {"/weather/frost": 1.0}, {"/weather/frost": math.nan},
        ):
            site.values = {**without, **change}
            site.until(lambda: newest(commands) == 0.0, LATE, f"stop by {change}")
            site.values = without
            site.until(lambda: newest(commands) == 1.0, LATE, f"on/off after {change}")
        site.values = {name: value for name, value in without.items() if name != "/cistern/level"}
        site.until(lambda: newest(commands) == 0.0, LATE, "stop without a level")
        site.values = good
        site.until(lambda: 0 < newest(commands) <= 0.4, LATE, "mpc again")


def test_a_moment_without_a_forecast_starts_no_pump(
    domain: int, tmp_path: Path, site: Site
) -> None:
    """Of a roof that waits for rain: on/off would pump."""
    commands = dry_site(site)
    (tmp_path / "mine.py").write_text(MINE)
    with live_node(domain, tmp_path, "controller --controller mine:Waiting", recovery_time=2.0):
        site.until(site.says("/waiting: forecast", OK), LATE, "a forecast")
        site.values["/forecast/precipitation"] = [math.nan] * 10
        site.until(site.says("/waiting: forecast", WARN, "was refused"), LATE, "the refusal")
        site.values["/forecast/precipitation"] = [0.0] * 10
        site.until(site.says("/waiting: forecast", OK), LATE, "a forecast again")
        assert {value for _, value in commands} == {0.0}


MINE = """
import math
from greenroof_ros.common.parameter import Parameter

class Waiting:
    parameters = ()
    def __init__(self, site): pass
    def command(self, *inputs): return 0.0
    def skip(self): pass
    def statistics(self): return None

class Counting(Waiting):
    parameters = (Parameter("base", 0.1, "1", 0.0, 1.0, "of its commands", may_change=True),)
    def __init__(self, site, base):
        self.base, self.asked = base, 0
    def command(self, *inputs):
        self.asked += 1
        return self.base + 0.001 * self.asked

class Own(Waiting):
    needs_forecast = False
    def command(self, cistern, roof, rain, evapotranspiration):
        return 0.3 if len(rain) == len(evapotranspiration) == 10 else 0.2

class Broken(Waiting):
    def command(self, *inputs): return math.nan
"""


def test_classes_of_a_users_own(domain: int, tmp_path: Path, site: Site) -> None:
    """One that says nothing leaves it to on/off and begins anew; one with a rule is asked."""
    commands = dry_site(site)
    good = dict(site.values)
    without = {name: value for name, value in good.items() if name not in FORECASTS}
    (tmp_path / "mine.py").write_text(MINE)
    given = {"recovery_time": 0.2, "forecast_limit": 1.0}
    with live_node(domain, tmp_path, "controller --controller mine:Counting", **given):
        site.until(lambda: (newest(commands) or 0) > 0.105, LATE, "its commands")
        site.values = without
        site.until(lambda: newest(commands) == 1.0, LATE, "on/off")
        client = site.node.create_client(SetParameters, "/counting/set_parameters")
        site.until(client.service_is_ready, LATE, "the service")
        base = Parameter("base", value=0.5).to_parameter_msg()
        answer = client.call_async(SetParameters.Request(parameters=[base]))
        site.until(answer.done, LATE, "an answer")
        before = len(commands)
        site.values = good
        site.until(lambda: newest(commands) != 1.0, LATE, "its commands again")
        first = next(value for _, value in commands[before:] if value != 1.0)
        assert first == pytest.approx(0.501)
    commands.clear()
    with live_node(domain, tmp_path, "controller --controller mine:Own", **given):
        site.until(lambda: newest(commands) == 0.3, LATE, "with a forecast")
        site.values = without
        site.until(lambda: newest(commands) == 0.2, LATE, "without")
        site.values = good
        site.until(lambda: newest(commands) == 0.3, LATE, "with a forecast again")
        assert {value for _, value in commands} <= {0.0, 0.2, 0.3}


def test_a_controller_whose_command_is_none(domain: int, tmp_path: Path, site: Site) -> None:
    """The forecast is good: no on/off in its place."""
    commands = dry_site(site)
    (tmp_path / "mine.py").write_text(MINE)
    with live_node(domain, tmp_path, "controller --controller mine:Broken", recovery_time=0.2):
        broken = site.says("/broken: command", ERROR, "must be a finite number")
        site.until(broken, LATE, "what is wrong")
        site.during(2)
        assert {value for _, value in commands} == {0.0}
        assert site.says("/broken: forecast", OK)()


def test_a_forecast_whose_layout_is_wrong(domain: int, tmp_path: Path, site: Site) -> None:
    """It ends a simulated run; a live node refuses it, as too many members, and lives on."""
    from std_msgs.msg import MultiArrayDimension, MultiArrayLayout

    commands = dry_site(site)
    with live_node(
        domain, tmp_path, "controller --controller mpc", max_command=0.4, recovery_time=0.2
    ):
        site.until(lambda: newest(commands), LATE, "a command")
        publisher = site._publishers["/forecast/precipitation"]
        del site.values["/forecast/precipitation"]
        for sizes, count, why in (((3, 5), 4, "layout is [3, 5]"), ((2, 10), 20, "has 2 members")):
            dimensions = [MultiArrayDimension(size=size) for size in sizes]
            publisher.publish(Float64MultiArray(
                layout=MultiArrayLayout(dim=dimensions), data=array("d", [0.0] * count)
            ))
            site.until(site.says("/mpc: forecast", WARN, why), LATE, "why")
            site.until(lambda: newest(commands) == 1.0, LATE, "on/off")


@pytest.mark.parametrize("when", ["suspended", "suspended_in_a_decision"])
def test_no_command_of_what_was_before_a_suspend(
    when: str, domain: int, tmp_path: Path, site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In which the clock stands still by which a process otherwise tells how old a value is."""
    (tmp_path / "sitecustomize.py").write_text(SUSPENDED)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    commands = dry_site(site)
    with live_node(domain, tmp_path, "controller --controller onoff", recovery_time=1.0):
        site.until(lambda: newest(commands), 60, "a command")
        (tmp_path / when).touch()
        site.until(lambda: newest(commands) == 0.0, LATE, "no command")
        site.until(lambda: any("stood still for 3600 s" in said for said in site.said), LATE, "why")
        site.until(lambda: newest(commands), LATE, "a command of what is new")


@pytest.mark.parametrize(("live", "policy"), [("true", "OTHER"), ("false", "BATCH")])
@pytest.mark.parametrize("node", ["controller --controller onoff", "pump"])
def test_who_may_be_preempted(
    domain: int, tmp_path: Path, site: Site, node: str, live: str, policy: str
) -> None:
    """A node of a simulation lets the others go on; one of a live site must be in time."""
    parameters: dict[str, object] = {"live": live}
    if node == "pump":
        parameters |= {
            "drive": "abb_acs880", "address": f"gateway://127.0.0.1:{free_ports(1)[0]}",
            "state_file": tmp_path / "state.json",
        }
    name = "/pump" if node == "pump" else "/onoff"
    with live_node(domain, tmp_path, node, **parameters) as process:
        site.until(lambda: name in site.diagnoses, 60, "the node")
        threads = [int(one.name) for one in Path(f"/proc/{process.pid}/task").iterdir()]
        assert len(threads) > 1
        assert {os.sched_getscheduler(thread) for thread in threads} == {
            getattr(os, f"SCHED_{policy}")
        }


def test_no_command_of_what_was_before_a_stop(domain: int, tmp_path: Path, site: Site) -> None:
    """The node is stopped for 7 s while the roof gets wet; a dry roof's command never follows.

    The limits are far longer, and there is no time to recover: its own pause is what it must see.
    """
    commands = dry_site(site)
    with live_node(
        domain, tmp_path, "controller --controller onoff", level_limit=60.0, recovery_time=0.0,
        jump_tolerance=1.0,
    ) as process:
        site.until(lambda: newest(commands), LATE, "a command")
        # What it says is heard, too, before it is stopped: discovery may take seconds.
        site.until(site.says("/onoff: inputs", OK), LATE, "all well")
        os.kill(process.pid, signal.SIGSTOP)
        site.during(1.0)
        before = len(commands)
        site.during(6.0)
        assert len(commands) == before
        dry = site.values["/roof/level"]
        site.values["/roof/level"] = lambda now: dry(now) + 0.04
        site.during(0.5)
        os.kill(process.pid, signal.SIGCONT)
        site.until(site.says("/onoff: inputs", ERROR, "this node itself stood still"), LATE, "why")
        site.until(site.says("/onoff: inputs", OK), LATE, "all well")
        site.during(0.5)
        after = [value for _, value in commands[before:]]
        assert after and set(after) == {0.0}
        site.values["/roof/level"] = dry
        site.until(lambda: newest(commands) > 0, LATE, "a command")


def test_a_node_that_is_killed_may_come_again_but_not_twice(
    domain: int, tmp_path: Path, site: Site
) -> None:
    """The dead one stays matched for 20 s, without a lease: that is no second publisher."""
    file = tmp_path / "forecast.csv"
    write_forecast(file, timedelta(0), 0.0, 15.0)
    commands = dry_site(site)
    site.values = {name: site.values[name] for name in ("/cistern/level", "/roof/level")}
    given = {"forecast": file, "recovery_time": 0.5}
    good = site.says("/onoff: inputs", OK)

    def publishers() -> list[Any]:
        return site.node.get_publishers_info_by_topic("/weather/frost")

    started = [start_live(domain, tmp_path, "weather", **given)]
    try:
        with live_node(domain, tmp_path, "controller --controller onoff", recovery_time=0.5):
            site.until(lambda: newest(commands) and len(publishers()) == 1, LATE, "a command")
            started[0].kill()
            started.append(start_live(domain, tmp_path, "weather", **given))
            site.until(lambda: len(publishers()) == 2, LATE, "the second beside the dead one")
            site.during(1)
            site.until(lambda: good() and newest(commands) > 0, LATE, "recovery")

            started.append(start_live(domain, tmp_path, "weather", **given))
            site.until(
                site.says("/onoff: inputs", ERROR, "/weather/frost has ", "publishers (weather)"),
                LATE, "two of one name",
            )
            site.until(lambda: newest(commands) == 0.0, LATE, "command 0")
            site.during(2)
            assert newest(commands) == 0.0
            started[-1].terminate()
            site.until(lambda: good() and newest(commands) > 0, LATE, "one alone")
    finally:
        for process in started:
            process.terminate()
        for process in started:
            process.wait(300)


IMPOSTOR = (
    "import sys, rclpy\n"
    "from rclpy.node import Node\n"
    "from std_msgs.msg import Float64\n"
    "from greenroof_ros.common.interface import read_live_topics\n"
    "from greenroof_ros.graph.messages import qos_profile\n"
    "rclpy.init()\n"
    "node = Node(sys.argv[1], start_parameter_services=False)\n"
    "topic = read_live_topics()[sys.argv[2]]\n"
    "publisher = node.create_publisher(Float64, sys.argv[2], qos_profile(topic.qos))\n"
    "node.create_timer(0.1, lambda: publisher.publish(Float64(data=float(sys.argv[3]))))\n"
    "rclpy.spin(node)\n"
)


@contextmanager
def impostor(domain: int, cwd: Path, name: str, topic: str, value: float) -> Iterator[None]:
    """Publish what another node does, under its name, and report nothing."""
    process = subprocess.Popen(
        [sys.executable, "-c", IMPOSTOR, name, topic, str(value)], cwd=cwd, env=environment(domain)
    )
    try:
        yield
    finally:
        process.kill()
        process.wait(120)


def test_an_impostor_of_the_same_name(domain: int, tmp_path: Path, site: Site) -> None:
    """A process that calls itself weather, beside the one that lives: no frost of it is believed.

    The topic has no lease, and both endpoints have one node's name.
    """
    file = tmp_path / "forecast.csv"
    write_forecast(file, timedelta(0), 0.0, 15.0)
    commands = dry_site(site)
    site.values = {name: site.values[name] for name in ("/cistern/level", "/roof/level")}
    with live_node(domain, tmp_path, "weather", forecast=file, recovery_time=0.5), live_node(
        domain, tmp_path, "controller --controller onoff", recovery_time=0.5
    ):
        site.until(lambda: newest(commands), 20, "a command")
        with impostor(domain, tmp_path, "weather", "/weather/frost", 0.0):
            site.until(
                site.says("/onoff: inputs", ERROR, "/weather/frost has 2 publishers (weather)"),
                60, "two of one name",
            )
            site.until(lambda: newest(commands) == 0.0, 60, "command 0")
            site.during(2)
            assert newest(commands) == 0.0


HEADER = "issued,time,precipitation [mm/h],evapotranspiration [mm/day],temperature [degC]"


def write_forecast(path: Path, ago: timedelta, rain: float, temperature: float) -> None:
    """Put a file with one issue of 12 hours in place."""
    issued = datetime.now(UTC).replace(microsecond=0) - ago
    lines = [
        f"{issued.isoformat()},{(issued + timedelta(hours=hour)).isoformat()},{rain},2.0,"
        f"{temperature}"
        for hour in range(12)
    ]
    draft = path.with_suffix(".new")
    draft.write_text("\n".join([HEADER, *lines, ""]))
    draft.replace(path)


def usual_evapotranspiration() -> set[float]:
    """Return what evaporates off the paper's bed, 68.8 m2, in each month (m3/s)."""
    months = read_yaml(CONFIG / "site.yaml")["monthly_evapotranspiration"]
    return {month / 1000 / 86400 * 68.8 for month in months}


def test_live_weather(domain: int, tmp_path: Path, site: Site) -> None:
    """A file that is replaced, broken and removed, gauges that come and go, an issue too old."""
    file = tmp_path / "forecast.csv"
    write_forecast(file, timedelta(minutes=1), 3.6, 15.0)
    rain = site.listen("/weather/precipitation")
    evapotranspiration = site.listen("/weather/evapotranspiration")
    frost = site.listen("/weather/frost")
    forecast = site.listen("/forecast/precipitation", Float64MultiArray)

    def expect(rain_now: float, frost_now: float, what: str) -> None:
        site.until(
            lambda: newest(rain) == pytest.approx(rain_now) and newest(frost) == frost_now,
            LATE, what,
        )

    with live_node(
        domain, tmp_path, "weather", forecast=file, gauge_limit=1.0, recovery_time=0.3,
    ):
        site.until(lambda: rain and forecast, LATE, "the weather")
        expect(1e-6, 0.0, "3.6 mm/h")
        assert list(newest(forecast)) == pytest.approx([1e-6] * 10)
        # 2 mm/day off 68.8 m2.
        site.until(lambda: evapotranspiration, LATE, "evapotranspiration")
        assert newest(evapotranspiration) == pytest.approx(0.002 * 68.8 / 86400)
        site.until(site.says("/weather: forecast", OK, "issued"), LATE, "all well")

        write_forecast(file, timedelta(0), 7.2, -1.0)
        expect(2e-6, 1.0, "the new file")

        file.write_text(HEADER + "\nnow,now,1.0,2.0,3.0\n")
        site.until(
            site.says("/weather: forecast", WARN, f"{file}, line 2", "'now'"),
            LATE, "the broken file",
        )
        file.unlink()
        site.until(
            site.says("/weather: forecast", WARN, f"{file}: cannot be read"), LATE, "no file"
        )
        expect(2e-6, 1.0, "the old forecast")

        site.values = {"/gauge/precipitation": 5e-6, "/gauge/temperature": 4.0}
        expect(5e-6, 0.0, "the gauges")
        site.until(
            lambda: list(newest(forecast)) == pytest.approx([5e-6] * 10),
            LATE, "their rain forecast",
        )
        site.values = {"/gauge/precipitation": math.nan, "/gauge/temperature": 500.0}
        expect(2e-6, 1.0, "the forecast again")
        for part in ("rain gauge", "thermometer"):
            site.until(site.says(f"/weather: {part}", WARN, "was refused"), LATE, part)
        site.values = {}
        site.until(
            site.says("/weather: thermometer", WARN, "older than 1 s", "gauge_limit"),
            LATE, "silence",
        )

        write_forecast(file, timedelta(hours=2, minutes=1), 3.6, 15.0)
        site.until(
            site.says("/weather: forecast", ERROR, "is older than 2 h"), LATE, "an old issue"
        )
        site.until(lambda: math.isnan(newest(frost)), LATE, "unknown frost")
        assert site.says("/weather: frost", ERROR, "unknown_frost_may_pump")()
        site.during(0.5)
        known = len(forecast), len(rain)
        unknown = len(frost)
        site.until(lambda: len(frost) > unknown + 4, LATE, "unknown frost again")
        assert (len(forecast), len(rain)) == known
        assert newest(evapotranspiration) in usual_evapotranspiration()

        write_forecast(file, timedelta(0), 3.6, 15.0)
        expect(1e-6, 0.0, "a good file")
        site.until(site.says("/weather: forecast", OK), LATE, "all well")


def test_live_weather_without_a_forecast(domain: int, tmp_path: Path, site: Site) -> None:
    """A thermometer says whether there is frost, and the site what evaporates in a month."""
    heard = {
        name: site.listen(f"/weather/{name}")
        for name in ("frost", "precipitation", "evapotranspiration")
    }
    forecasts = [site.listen(name, Float64MultiArray) for name in FORECASTS]
    with live_node(
        domain, tmp_path, "weather", forecast="''", gauge_limit=1.0, recovery_time=0.3,
    ):
        site.until(lambda: heard["evapotranspiration"], LATE, "evapotranspiration")
        assert newest(heard["evapotranspiration"]) in usual_evapotranspiration()
        site.until(lambda: heard["frost"], LATE, "frost")
        assert math.isnan(newest(heard["frost"]))
        assert not heard["precipitation"]
        site.values = {"/gauge/temperature": 4.0, "/gauge/precipitation": 5e-6}
        site.until(lambda: newest(heard["frost"]) == 0.0, LATE, "no frost")
        site.until(lambda: newest(heard["precipitation"]) == 5e-6, LATE, "rain")
        site.values["/gauge/temperature"] = -0.5
        site.until(lambda: newest(heard["frost"]) == 1.0, LATE, "frost")
        site.values = {}
        site.until(lambda: math.isnan(newest(heard["frost"])), LATE, "unknown frost")
        silent = site.says("/weather: thermometer", WARN, "the present temperature is unknown")
        site.until(silent, LATE, "why")
        assert "/weather: forecast" not in site.diagnoses
        assert not any(forecasts)


def test_live_weather_of_a_site_without_a_climate(
    domain: int, tmp_path: Path, site: Site
) -> None:
    """What evaporates is not known, and is not said."""
    text = (CONFIG / "site.yaml").read_text()
    lines = [line for line in text.splitlines() if not line.startswith("monthly_")]
    (tmp_path / "mine.yaml").write_text("\n".join(lines))
    frost = site.listen("/weather/frost")
    evapotranspiration = site.listen("/weather/evapotranspiration")
    given = {"forecast": "''", "site_file": tmp_path / "mine.yaml"}
    with live_node(domain, tmp_path, "weather", **given):
        site.until(lambda: len(frost) > 2, LATE, "frost")
        assert not evapotranspiration


def test_unknown_frost_may_pump(domain: int, tmp_path: Path, site: Site) -> None:
    """Without a file at the start the node waits for one; the parameter makes frost 0."""
    frost = site.listen("/weather/frost")
    with live_node(
        domain, tmp_path, "weather", forecast="missing.csv", unknown_frost_may_pump="true"
    ):
        site.until(lambda: newest(frost) == 0.0, LATE, "no frost")
        site.until(site.says("/weather: frost", WARN, "may run all the same"), LATE, "a warning")
        assert site.says("/weather: forecast", ERROR, "missing.csv: cannot be read")()


def test_live_weather_needs_a_file(domain: int, tmp_path: Path) -> None:
    """A model of forecasts is made of records, which a live site does not have."""
    done = subprocess.run(
        [
            sys.executable, "-m", "greenroof_ros.nodes.weather", "--ros-args", "-p", "live:=true",
            "-p", "forecast:=persistence",
        ],
        cwd=tmp_path, env=environment(domain), capture_output=True, text=True, timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert "parameter forecast of weather = 'persistence': must be a FILE.csv" in done.stderr
    assert len(done.stderr.splitlines()) == 1
