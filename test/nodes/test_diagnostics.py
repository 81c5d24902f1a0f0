"""/diagnostics as ROS tools read it: names, hardware, stamps, numbers; the aggregator's rules."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from graphs import Process, environment
from places import CONFIG

from greenroof_ros.common.files import read_yaml
from greenroof_ros.controllers.registry import BUILT_IN

pytest.importorskip("rclpy", reason="nodes need ROS 2")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from test_live import Site, dry_site, live_node, site  # noqa: F401
from test_live_recorder import recorder
from test_nodes import Observer, observer, qos  # noqa: F401

OK, WARN, ERROR, STALE = range(4)
AGGREGATOR = CONFIG / "diagnostics" / "aggregator.yaml"


class Listener:
    """All that came on /diagnostics, and when (s of the steady clock)."""

    def __init__(self, watcher: Observer) -> None:
        """Listen from now on."""
        self.arrays: list[tuple[float, DiagnosticArray]] = []
        watcher.node.create_subscription(
            DiagnosticArray, "/diagnostics",
            lambda array: self.arrays.append((time.monotonic(), array)), qos("/diagnostics"),
        )

    def statuses(self, until: float | None = None) -> list[tuple[float, DiagnosticStatus]]:
        """Return what came until some time."""
        return [
            (at, status) for at, array in self.arrays if until is None or at <= until
            for status in array.status
        ]

    def values(self, name: str) -> dict[str, Any]:
        """Return what a node said last."""
        found = [status for _, status in self.statuses() if status.name == name]
        return {entry.key: json.loads(entry.value) for entry in found[-1].values} if found else {}

    def check(self, hardware: Iterable[str]) -> None:
        """Hold every message against what tools rely on."""
        for _, array in self.arrays:
            assert array.header.stamp.sec > 0
            assert array.status
        identity: dict[str, str] = {}
        for _, status in self.statuses():
            assert re.fullmatch(r"(/\w+)+(: \w[\w ]*)?", status.name)
            assert identity.setdefault(status.name, status.hardware_id) == status.hardware_id
            assert status.level[0] in (OK, WARN, ERROR, STALE)
            assert status.message
            keys = [entry.key for entry in status.values]
            assert len(set(keys)) == len(keys)
        assert set(identity.values()) == set(hardware)
        # Tools that show names without their slashes, or make codes of them, keep them apart.
        codes = {re.sub(r"\W+", "_", name).strip("_").upper() for name in identity}
        assert len(codes) == len(identity) and "" not in codes


class GenericAnalyzer:
    """The documented rules of diagnostic_aggregator's analyzer of that name, as far as used here.

    It takes the items whose names start with one of ``startswith`` or are ``expected``; the newest
    of each counts. An item that did not come for ``timeout`` is stale, one that is expected and
    never came, too. The worst level is the group's; it is stale where all items are, and where
    some are, it has an error.
    """

    def __init__(self, parameters: dict[str, Any]) -> None:
        """Take the analyzer's section of a parameter file."""
        assert parameters.pop("type") == "diagnostic_aggregator/GenericAnalyzer"
        self.path = parameters.pop("path")
        self._starts = tuple(parameters.pop("startswith"))
        self._expected = set(parameters.pop("expected", []))
        self._timeout = parameters.pop("timeout", 5.0)
        assert not parameters

    def matches(self, name: str) -> bool:
        """Whether it takes an item."""
        return name.startswith(self._starts) or name in self._expected

    def level(self, statuses: list[tuple[float, DiagnosticStatus]], now: float) -> int:
        """Return the group's level at a time."""
        newest = {
            status.name: (at, status.level[0])
            for at, status in statuses if at <= now and self.matches(status.name)
        }
        levels = [STALE if now - at > self._timeout else level for at, level in newest.values()]
        levels += [STALE for _ in self._expected - newest.keys()]
        return worst(levels)


def worst(levels: list[int]) -> int:
    """Return the level of a group, or of groups."""
    if all(level == STALE for level in levels):
        return STALE
    return min(max(levels), ERROR)


def analyzers() -> list[GenericAnalyzer]:
    """Return those of the file that comes with the package."""
    parameters = read_yaml(AGGREGATOR)["analyzers"]["ros__parameters"]
    assert parameters.pop("path") == "Greenroof"
    return [GenericAnalyzer(dict(section)) for section in parameters.values()]


def test_every_node_has_its_group() -> None:
    """And only one: controllers of this package, both recorders, what is simulated or live."""
    groups = analyzers()
    names = [
        "plant", "weather", "recorder", "pump", "cistern_sensor", "roof_sensor", *BUILT_IN,
    ]
    for name in names:
        for item in (f"/{name}", f"/{name}: inputs"):
            assert len([group for group in groups if group.matches(item)]) == 1, item
    assert not [group for group in groups if group.matches("/camera: temperature")]


def test_simulated_run(
    domain: int, tmp_path: Path, observer: Observer,  # noqa: F811
) -> None:
    """All groups are well while it runs, and all are stale once it is over for 5 s."""
    heard = Listener(observer)
    process = Process(
        domain, "bringup", "--output", "run", "--hours", "0.1", "--speed", "45", cwd=tmp_path
    )
    observer.until(lambda: process.process.poll() is not None, 120, "the end of the run")
    assert process.wait(300) == 0, process.stderr()
    heard.check({socket.gethostname()})
    names = {"/plant", "/weather", "/mpc", "/recorder"}
    assert {status.name for _, status in heard.statuses()} == names

    # While all nodes are in the run.
    ready = [(at, status.name) for at, status in heard.statuses() if status.message == "ready"]
    began = max(min(at for at, one in ready if one == name) for name in names)
    ended = min(max(at for at, one in ready if one == name) for name in names)
    assert ended - began > 6
    moments = [began + step * 0.1 for step in range(int((ended - began) / 0.1))]
    statuses, groups = heard.statuses(), analyzers()
    for now in moments:
        levels = {group.path: group.level(statuses, now) for group in groups}
        assert set(levels.values()) == {OK}, (now - began, levels)
        assert worst(list(levels.values())) == OK
    last = statuses[-1][0]
    assert [group.level(statuses, last + 5.1) for group in groups] == [STALE] * len(groups)

    # The numbers that a watcher needs, and where the site and the bag are.
    plant = heard.values("/plant")
    assert isinstance(plant["roof_level"], float) and plant["tick"] == 360
    for name in ("/plant", "/weather", "/mpc"):
        assert heard.values(name)["site"] == str(tmp_path / "run" / "configuration" / "site.yaml")
    assert heard.values("/recorder")["bag"] == str(tmp_path / "run" / "bag")


def test_failure_of_a_node(
    domain: int, tmp_path: Path, observer: Observer,  # noqa: F811
) -> None:
    """The last word of a node that failed is an error; its process and site are in its values."""
    heard = Listener(observer)
    (tmp_path / "my_site.yaml").write_text((CONFIG / "site.yaml").read_text())
    process = subprocess.Popen(
        [sys.executable, "-m", "greenroof_ros.nodes.plant", "--ros-args",
         "-p", "start_limit:=15.0", "-p", "site_file:=my_site.yaml"],
        cwd=tmp_path, env=environment(domain),
    )
    observer.until(
        lambda: heard.arrays and heard.statuses()[-1][1].message == "ended", 60, "the end"
    )
    assert process.wait(300) == 1
    heard.check({socket.gethostname()})
    *before, (at, last) = heard.statuses()
    assert {status.level[0] for _, status in before} == {OK}
    assert last.level[0] == ERROR
    (group,) = [group for group in analyzers() if group.matches("/plant")]
    assert [group.level(heard.statuses(), now) for now in (at, at + 5.1)] == [ERROR, STALE]
    values = heard.values("/plant")
    assert "no start within 15 s" in values["failure"]
    assert values["process"] == f"{socket.gethostname()} {process.pid}"
    assert values["site"] == str(tmp_path / "my_site.yaml")


def test_parts_of_live_nodes(
    domain: int, tmp_path: Path, site: Site, observer: Observer,  # noqa: F811
) -> None:
    """A part that is not well makes its group so, while its node's own status is OK."""
    heard = Listener(observer)
    dry_site(site)
    (group,) = [group for group in analyzers() if group.matches("/onoff")]

    def level() -> int:
        return group.level(heard.statuses(), time.monotonic())

    with live_node(domain, tmp_path, "controller --controller onoff", recovery_time=1.0):
        site.until(site.says("/onoff: inputs", b"\x00"), 60, "good inputs")
        site.until(lambda: level() == OK, 60, "a group that is well")
        del site.values["/roof/level"]
        site.until(lambda: level() == ERROR, 60, "a group with an error")
        newest = {status.name: status.level[0] for _, status in heard.statuses()}
        assert newest == {"/onoff": OK, "/onoff: inputs": ERROR}
        assert heard.values("/onoff")["site"] == str(tmp_path / "site.yaml")
        with recorder(domain, tmp_path / "kept"):
            site.until(lambda: heard.values("/recorder"), 60, "the recorder")
            assert heard.values("/recorder")["bag"] == str(tmp_path / "kept")
    heard.check({socket.gethostname()})
