"""How messages call the nodes of publishers."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="the module needs ROS 2")

from greenroof_ros.graph.publishers import call_node


def test_a_node_whose_name_never_came_is_called_so_in_words() -> None:
    """The name is rmw_dds_common's for a participant that it has no node of."""
    assert call_node("mpc") == "mpc"
    assert call_node("_NODE_NAME_UNKNOWN_") == (
        "a node whose name is not known, such as one that was killed"
    )
