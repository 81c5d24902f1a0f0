"""Sections of a parameter file apply to nodes as in rcl."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import permutations
from pathlib import Path
from typing import Any

import pytest

from greenroof_ros.base.parameter import read_sections


@contextmanager
def node_with(file: Path, domain: int, namespace: str = "/") -> Iterator[Any]:
    """A node that has read a parameter file by rcl."""
    rclpy = pytest.importorskip("rclpy", reason="rcl comes with ROS 2")
    from rclpy.node import Node

    context = rclpy.Context()
    rclpy.init(
        args=["--ros-args", "--params-file", str(file), "-r", f"__ns:={namespace}"],
        context=context, domain_id=domain,
    )
    try:
        node = Node(
            "reader", context=context, automatically_declare_parameters_from_overrides=True,
            start_parameter_services=False, enable_rosout=False,
        )
        yield node
        node.destroy_node()
    finally:
        context.try_shutdown()


SECTIONS = ("/**", "reader", "/reader", "/**/reader", "/*/reader", "/*", "/x/**", "/x/reader", "y")


@pytest.mark.parametrize("namespace", ["/", "/x", "/x/y"])
def test_sections_apply_to_nodes_as_rcl_applies_them(
    namespace: str, tmp_path: Path, domain: int
) -> None:
    """Two sections at a time, in both orders, one in a namespace; groups become dots."""
    file = tmp_path / "parameters.yaml"
    for first, second in permutations(SECTIONS, 2):
        file.write_text(
            f"{first}:\n  ros__parameters: {{a: 1, b: {{c: {{d: 2}}}}}}\n"
            f"{second}:\n  ros__parameters: {{a: 3}}\n"
            "x:\n  reader:\n    ros__parameters: {e: 4}\n"
        )
        given = dict[str, Any]()
        for section in read_sections(file):
            if section.applies_to(f"{namespace.rstrip('/')}/reader"):
                given |= section.values
        with node_with(file, domain, namespace) as node:
            known = node.get_parameters_by_prefix("").items()
            theirs = {name: value.value for name, value in known if name[1:2] in ("", ".")}
        assert given == theirs, (first, second)
