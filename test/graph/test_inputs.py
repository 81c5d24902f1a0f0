"""What a node takes of its inputs, and what it calls those who publish them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the module needs ROS 2")

from rclpy.logging import get_logger

from greenroof_ros.common.interface import read_topics
from greenroof_ros.graph.inputs import Input, by_publisher, call_node, root_causes
from greenroof_ros.graph.messages import encoder


def test_a_node_whose_name_never_came_is_called_so_in_words() -> None:
    """The name is rmw_dds_common's for a participant that it has no node of."""
    assert call_node("mpc") == "mpc"
    assert call_node("_NODE_NAME_UNKNOWN_") == (
        "a node whose name is not known, such as one that was killed"
    )


def test_what_a_subscriber_takes_of_a_plan() -> None:
    """Rows and emptiness are good; what was not decided is refused, as any NaN, and acts as 0."""
    topic = read_topics()["/controller/plan"]
    encode = encoder(topic.type, topic.dimensions)
    publishers = SimpleNamespace(topic=topic, full_name=topic.name)
    entry = Input(publishers, get_logger("test"))
    for value in (np.array([[10.0, 0.008, 0.036], [20.0, 0.0, 0.0]]), np.empty((0, 3))):
        entry.receive(encode(value))
        assert entry.good and np.asarray(entry.value).size == value.size
    entry.receive(encode(topic.undecided))
    assert not entry.good and list(entry.value) == [0.0] * 3


def test_root_causes_of_the_interface() -> None:
    """Who waits for whom, as the plant sees it."""
    topics = read_topics()
    external = {
        name: topics[name]
        for name in (
            "/weather/precipitation", "/weather/evapotranspiration", "/pump/command", "/pump/flow"
        )
    }

    def causes(*missing: str) -> set[str]:
        return root_causes(by_publisher(missing, external, "plant"), topics.values())

    assert causes("/weather/precipitation", "/pump/command", "/pump/flow") == {"weather"}
    assert causes("/pump/command", "/pump/flow") == {"controller"}
    assert causes("/pump/flow") == {"pump"}
