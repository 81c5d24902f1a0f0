"""Single nodes in a live graph: parameters, values that are refused, two masters, restarts."""

from __future__ import annotations

import json
import math
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from typing import Any

import pytest
from commands import run_command
from graphs import Process, environment, summary_of, udp_addresses_of, wait_for

rclpy = pytest.importorskip("rclpy", reason="nodes need ROS 2")

from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue  # noqa: E402
from rcl_interfaces.srv import GetParameters, SetParameters  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from std_msgs.msg import Float64  # noqa: E402

from greenroof_ros.common.interface import read_live_topics, read_topics  # noqa: E402
from greenroof_ros.graph.messages import qos_profile  # noqa: E402


def qos(topic: str) -> Any:
    """Return a topic's profile in the interface."""
    return qos_profile(read_topics()[topic].qos)


def offered(topic: str) -> Any:
    """Return what a publisher offers to be heard in either kind of graph."""
    return qos_profile({**read_topics(), **read_live_topics()}[topic].qos)


class Observer:
    """A node of the test's own."""

    def __init__(self, domain: int) -> None:
        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context, domain_id=domain)
        self.node = Node("observer", context=self.context, start_parameter_services=False)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def until(self, condition: Callable[[], Any], seconds: float, what: str) -> Any:
        """Spin until a condition holds."""

        def spun() -> Any:
            self.executor.spin_once(timeout_sec=0.05)
            return condition()

        return wait_for(spun, seconds, what)


@pytest.fixture
def observer(domain: int) -> Iterator[Observer]:
    it = Observer(domain)
    yield it
    it.node.destroy_node()
    it.context.try_shutdown()


@contextmanager
def nodes(domain: int, cwd: Path, *commands: str) -> Iterator[list[subprocess.Popen[str]]]:
    """Start nodes by hand, and end them by Ctrl-C."""
    started = [
        subprocess.Popen(
            [sys.executable, "-m", *f"greenroof_ros.nodes.{command}".split()],
            cwd=cwd, env=environment(domain), stderr=subprocess.PIPE, text=True,
        )
        for command in commands
    ]
    try:
        yield started
    finally:
        for process in started:
            process.send_signal(signal.SIGINT)
        for process in started:
            process.wait(300)


def final_report(observer: Observer, node: str) -> dict[str, Any]:
    """Wait for what a node says on /diagnostics at the end of a run."""
    from diagnostic_msgs.msg import DiagnosticArray

    found: dict[str, Any] = {}

    def on_report(array: DiagnosticArray) -> None:
        for status in array.status:
            if status.name == f"/{node}" and status.message == "finished":
                found.update({entry.key: json.loads(entry.value) for entry in status.values})

    observer.node.create_subscription(
        DiagnosticArray, "/diagnostics", on_report, qos("/diagnostics")
    )
    observer.until(lambda: found, 60, f"the final report of {node}")
    return found


def test_bad_command_acts_as_zero_and_is_counted(
    domain: int, tmp_path: Path, observer: Observer
) -> None:
    """A command that is not finite or negative never becomes a flow."""
    flows: list[float] = []
    bad = cycle([math.nan, math.inf, -0.5, -math.inf])
    publisher = observer.node.create_publisher(Float64, "/pump/command", qos("/pump/command"))
    observer.node.create_subscription(
        Float64, "/roof/level", lambda _: publisher.publish(Float64(data=next(bad))),
        qos("/roof/level"),
    )
    observer.node.create_subscription(
        Float64, "/pump/flow", lambda message: flows.append(message.data), qos("/pump/flow")
    )
    with nodes(domain, tmp_path, "plant --ros-args -p run_length:=20", "weather") as started:
        report = final_report(observer, "plant")
        # The report may come before the last flow, which is another topic.
        observer.until(lambda: len(flows) >= 21, 60, "the last flow")
    assert report["refused"] == {"/pump/command": 21}
    assert report["metrics"]["pumped_m3"] == 0.0
    assert flows == [0.0] * 21
    assert "refused" in started[0].communicate()[1]


def test_bad_level_or_frost_stops_the_pump(
    domain: int, tmp_path: Path, observer: Observer
) -> None:
    """A level that no sensor can have measured is not a dry roof; frost and bad frost pump not."""
    from std_msgs.msg import Float64MultiArray

    commands: list[float] = []
    observer.node.create_subscription(
        Float64, "/pump/command", lambda message: commands.append(message.data),
        qos("/pump/command"),
    )
    publish = {
        name: observer.node.create_publisher(kind, name, qos(name))
        for name, kind in (
            ("/cistern/level", Float64),
            ("/roof/level", Float64),
            ("/forecast/precipitation", Float64MultiArray),
            ("/forecast/evapotranspiration", Float64MultiArray),
            ("/weather/frost", Float64),
        )
    }
    with nodes(domain, tmp_path, "controller --controller mpc"):
        observer.until(
            lambda: all(each.get_subscription_count() for each in publish.values()), 60, "mpc"
        )
        good = (0.03, 0.0)
        inputs = [
            good, (math.nan, 0.0), good, (-1.0, 0.0), good, (1e6, 0.0), good, (0.03, 1.0),
            good, (0.03, math.nan),
        ]
        for tick, (roof, frost) in enumerate(inputs):
            publish["/cistern/level"].publish(Float64(data=2.5))
            publish["/roof/level"].publish(Float64(data=roof))
            publish["/weather/frost"].publish(Float64(data=frost))
            publish["/forecast/precipitation"].publish(Float64MultiArray(data=[0.0] * 10))
            publish["/forecast/evapotranspiration"].publish(Float64MultiArray(data=[0.0] * 10))
            observer.until(lambda tick=tick: len(commands) == tick + 1, 60, f"command {tick}")
    assert all(command > 0 for command in commands[::2])
    assert commands[1::2] == [0.0] * 5


@pytest.mark.parametrize(
    "when", ["Node.destroy_node = lambda node: hang()", "import atexit; atexit.register(hang)"],
    ids=["destroy_node", "end of the process"],
)
def test_middleware_that_locks_up_at_the_end(domain: int, tmp_path: Path, when: str) -> None:
    """A teardown that hangs, and lets no Python run: the node ends all the same."""
    hangs = (
        "import ctypes; from rclpy.node import Node; from greenroof_ros.nodes.weather import main; "
        f"hang = lambda: ctypes.PyDLL(None).sleep(60); {when}; main()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", hangs], cwd=tmp_path, env=environment(domain)
    )
    wait_for(lambda: udp_addresses_of(process.pid), 60, "the start of the node")
    process.send_signal(signal.SIGINT)
    assert process.wait(300) == -signal.SIGALRM


def test_two_masters(domain: int, tmp_path: Path, observer: Observer) -> None:
    """A second publisher of the command ends the run, and the message names the topic."""
    process = Process(domain, "bringup", "--speed", "20", "--output", "run", cwd=tmp_path)
    process.wait_for_ticks(size=0)
    assert weight_setter(observer)(0.01).successful
    observer.node.create_publisher(Float64, "/pump/command", qos("/pump/command"))
    observer.until(lambda: process.process.poll() is not None, 60, "the end of the run")
    assert process.wait(300) == 1
    assert "/pump/command has 2 publishers (mpc, observer)" in process.stderr()
    assert "Traceback" not in process.stderr()
    # What is known of a run is written also where it fails, with the words of the node.
    summary = summary_of(tmp_path / "run")
    assert "/pump/command has 2 publishers (mpc, observer)" in summary["reason"]
    (change,) = summary["parameter_changes"]
    assert (change["parameter"], change["value"]) == ("weight", 0.01)
    assert 0 <= change["tick"] <= summary["last_tick"]


def weight_setter(observer: Observer) -> Callable[[float], Any]:
    """Wait for the service, and return what asks for a weight and returns the answer."""
    client = observer.node.create_client(SetParameters, "/mpc/set_parameters")
    observer.until(client.service_is_ready, 60, "the parameter service")

    def set_weight(value: float) -> Any:
        given = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
        if isinstance(value, int):  # as `ros2 param set /mpc weight 5` sends it
            given = ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=value)
        parameter = Parameter(name="weight", value=given)
        future = client.call_async(SetParameters.Request(parameters=[parameter]))
        observer.until(future.done, 60, "an answer")
        return future.result().results[0]

    return set_weight


def test_weight_is_set_during_a_run(domain: int, tmp_path: Path, observer: Observer) -> None:
    """A valid weight takes effect, recorded with its tick; others are refused with a reason."""
    process = Process(
        domain, "bringup", "--output", "run", "--hours", "0.2", "--speed", "40", cwd=tmp_path
    )
    set_weight = weight_setter(observer)
    for bad in (-1.0, 0.0, -5, math.nan, math.inf):
        refused = set_weight(bad)
        assert not refused.successful
        assert "weight" in refused.reason
    assert set_weight(0.01).successful
    assert set_weight(5).successful
    assert process.wait(300) == 0, process.stderr()
    summary = summary_of(tmp_path / "run")
    change, to_five = summary["parameter_changes"]
    assert (to_five["before"], repr(to_five["value"])) == (0.01, "5.0")
    assert (change["parameter"], change["before"], change["value"]) == ("weight", 0.001, 0.01)
    time = f"00:{change['tick'] // 60:02}"
    assert f"0.001 -> 0.01 at {time} (tick {change['tick']})" in " ".join(
        re.sub("[│\n]", " ", process.stdout()).split()
    )
    assert 0 <= change["tick"] <= 720


def test_simulated_time(domain: int, tmp_path: Path, observer: Observer) -> None:
    """Every node has use_sim_time, follows its own graph's clock, and stamps its reports by it.

    The graph is in a namespace; a clock on /clock, a day later, is not its own.
    """
    from diagnostic_msgs.msg import DiagnosticArray
    from rosgraph_msgs.msg import Clock

    start, ticks = 1_625_641_200, 720  # 2021-07-07T02:00-05:00 in seconds since 1970
    stamps: dict[str, list[int]] = {}
    began = time.time()

    def on_report(array: DiagnosticArray) -> None:
        for status in array.status:
            stamps.setdefault(status.name, []).append(array.header.stamp.sec)

    observer.node.create_subscription(
        DiagnosticArray, "/diagnostics", on_report, qos("/diagnostics")
    )
    other = observer.node.create_publisher(Clock, "/clock", 10)
    message = Clock()
    message.clock.sec = start + 86_400
    names = [f"/site1/{name}" for name in ("plant", "weather", "mpc", "recorder")]
    process = Process(
        domain, "bringup", "--output", "run", "--namespace", "site1", "--hours", "0.2",
        "--speed", "120", cwd=tmp_path,
    )
    for name in names:
        client = observer.node.create_client(GetParameters, f"{name}/get_parameters")
        observer.until(client.service_is_ready, 60, f"the parameters of {name}")
        future = client.call_async(GetParameters.Request(names=["use_sim_time"]))
        observer.until(future.done, 60, "an answer")
        assert future.result().values[0].bool_value is True

    def ended() -> bool:
        other.publish(message)
        return process.process.poll() is not None

    observer.until(ended, 60, "the end of the run")
    assert process.wait(300) == 0, process.stderr()
    for name in names:
        # The system's time until the first tick; then it moves with the run, to its end.
        first = next(i for i, stamp in enumerate(stamps[name]) if stamp < began - 1)
        assert all(began - 1 < stamp < time.time() for stamp in stamps[name][:first]), name
        moved = [stamp - start for stamp in stamps[name][first:]]
        assert moved == sorted(moved), name
        assert 0 <= moved[0] < moved[-1] <= ticks, name


def test_whole_numbers_and_the_file_for_all_nodes(
    domain: int, tmp_path: Path, observer: Observer
) -> None:
    """``/**:`` and ``weight: 5`` are how most parameter files look; so does ``-p weight:=5``."""
    (tmp_path / "mine.yaml").write_text("/**:\n  ros__parameters:\n    weight: 5\n")

    def weight() -> ParameterValue:
        client = observer.node.create_client(GetParameters, "/mpc/get_parameters")
        observer.until(client.service_is_ready, 60, "the parameters of mpc")
        future = client.call_async(GetParameters.Request(names=["weight"]))
        observer.until(future.done, 60, "an answer")
        return future.result().values[0]

    for options in ("--params-file mine.yaml", "-p weight:=5"):
        with nodes(domain, tmp_path, f"controller --controller mpc --ros-args {options}"):
            given = weight()
        assert given.type == ParameterType.PARAMETER_DOUBLE, options
        assert given.double_value == 5.0, options
    for option in ("--parameters", "--node-parameters"):
        command = ("bringup", option, "mine.yaml", "--output", option[2:], "--hours", "0.05")
        process = Process(domain, *command, cwd=tmp_path)
        assert process.wait(300) == 0, process.stderr()
    assert summary_of(tmp_path / "parameters")["parameters"]["weight"] == 5.0


def test_parameter_file_is_honoured(domain: int, tmp_path: Path, observer: Observer) -> None:
    """--params-file decides what the node does."""
    (tmp_path / "plant.yaml").write_text(
        "plant:\n  ros__parameters:\n    initial_cistern_volume: 50.0\n"
        "    initial_roof_volume: 3.0\n    run_length: 5\n    speed: 1.0\n"
    )
    with nodes(domain, tmp_path, "plant --ros-args --params-file plant.yaml", "weather"):
        observer.until(
            lambda: "plant" in [
                info.node_name
                for info in observer.node.get_publishers_info_by_topic("/diagnostics")
            ],
            60, "a plant that can be heard",
        )
        with nodes(domain, tmp_path, "controller --controller onoff"):
            report = final_report(observer, "plant")
    assert report["tick"] == 5
    assert report["metrics"]["final_cistern_m3"] < 50.0
    assert report["metrics"]["final_roof_m3"] == pytest.approx(3.0, abs=0.1)
    assert report["sent"]["/clock"] == 6


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("controller --controller mpc --ros-args -p weight:=-1.0", ("weight", "-1.0", "1e-09")),
        ("controller --controller mpc --ros-args -p weight:=heavy", ("weight", "heavy", "number")),
        ("controller --controller pid", ("pid", "mpc", "package.module:Class")),
        ("controller --controller onoff --ros-args -p fraction:=.nan", ("fraction",)),
        ("plant --ros-args -p initial_roof_volume:=-1.0", ("initial_roof_volume", "-1.0")),
        (
            "plant --ros-args -p initial_roof_volume:=250.0",
            ("initial_roof_volume = 250.0", "at most 159.96 m3", "250 mm is 17.2 m3"),
        ),
        (
            "plant --ros-args -p initial_cistern_volume:=401.0",
            ("initial_cistern_volume = 401.0", "at most 400 m3"),
        ),
        ("plant --ros-args -p run_length:=0", ("run_length", "0")),
        ("plant --ros-args -p pump:=outside", ("pump", "outside", "external")),
        ("plant --ros-args -p start:=noon", ("start", "noon")),
        ("plant --ros-args -p site_file:=nowhere.yaml", ("nowhere.yaml",)),
        ("weather --ros-args -p weather_files:=[nowhere.csv]", ("nowhere.csv",)),
        ("weather --ros-args -p weather_files:=[]", ("weather_files", "at least one file")),
        ("weather --ros-args -p run_length:=10000000", ("toronto_2021-07.csv",)),
        ("recorder --ros-args -p directory:=.", ("directory", "exists")),
        ("recorder --ros-args -p controller:=pid", ("controller", "pid", "mpc")),
    ],
)
def test_wrong_parameters(
    domain: int, tmp_path: Path, command: str, words: tuple[str, ...]
) -> None:
    """Exit code 2 and one clear message, as of the commands."""
    done = run_command(*f"nodes.{command}".split(), cwd=tmp_path, env=environment(domain))
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("error:") == 1
    assert "Traceback" not in done.stderr
    for word in words:
        assert word in done.stderr
