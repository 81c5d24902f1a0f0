"""A node of the test, and the site that it simulates; without ROS 2 these tests are skipped."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from ros_rig import Observer, Site

collect_ignore_glob = ["test_*.py"] if find_spec("rclpy") is None else []
if find_spec("pymodbus") is None:  # drives and sensors use Modbus
    collect_ignore_glob += ["test_pump_node.py", "test_live_bringup.py"]


@pytest.fixture
def observer(domain: int, tmp_path: Path) -> Iterator[Observer]:
    from ros_rig import Observer

    observer = Observer(domain, tmp_path)
    yield observer
    observer.close()


@pytest.fixture
def site(observer: Observer) -> Site:
    from ros_rig import Site

    return Site(observer)
