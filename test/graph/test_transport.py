"""The two files of settings of Fast DDS."""

from __future__ import annotations

from xml.etree import ElementTree

from places import CHECKOUT


def publisher(name: str) -> bytes:
    """Return what a file sets of publishers."""
    root = ElementTree.parse(CHECKOUT / "config" / name).getroot()
    element = root.find("{*}publisher")
    assert element is not None
    element.tail = None
    return ElementTree.tostring(element)


def test_both_files_set_the_same_of_publishers() -> None:
    """Whether the graph stays on the machine or not; Fast DDS reads one file only."""
    assert publisher("fastdds.xml") == publisher("fastdds_loopback.xml")
