"""The layouts in config/layouts/, compared with the interface."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from xml.etree import ElementTree

import pytest
from places import CHECKOUT, CONFIG

from greenroof_ros.interface.topics import read_topics

sys.path.append(str(CHECKOUT / "doc"))

from layouts import LAYOUTS

FOXGLOVE = CONFIG / "layouts" / "greenroof.foxglove.json"
PLOTJUGGLER = CONFIG / "layouts" / "greenroof.plotjuggler.xml"
TARGET = "Target (mm)"
SHOWN = {
    "/roof/level", "/cistern/level", "/pump/command", "/pump/flow", "/pump/meter",
    "/weather/precipitation", "/weather/evapotranspiration", "/gauge/precipitation",
    "/roof/drainage", "/cistern/outflow", "/outlet/command", "/outlet/flow",
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts_are_made_from_the_interface(name: str) -> None:
    """'make docs' would write nothing else."""
    assert (CONFIG / "layouts" / name).read_text(encoding="utf-8") == LAYOUTS[name]()


Scales = dict[str, tuple[str, float]]


def of_foxglove() -> tuple[Scales, set[str]]:
    """Return topic and factor of each script by its label, and the labels of all lines."""
    layout = json.loads(FOXGLOVE.read_text(encoding="utf-8"))
    scales = {}
    for script in layout["userNodes"].values():
        (topic,) = re.findall(r'^export const inputs = \["(.+)"\];$', script["sourceCode"], re.M)
        (factor,) = re.findall(r"event\.message\.data \* ([\d.]+)\)", script["sourceCode"])
        scales[script["name"]] = topic, float(factor)
    panels = layout["configById"].values()
    return scales, {line["label"] for panel in panels for line in panel.get("paths", [])}


def of_plotjuggler() -> tuple[Scales, set[str]]:
    """Return topic and factor of each function by its label, and the labels of all curves."""
    root = ElementTree.parse(PLOTJUGGLER).getroot()
    scales = {}
    for snippet in root.iterfind("customMathEquations/snippet"):
        topic, code = snippet.findtext("linked_source", ""), snippet.findtext("function", "")
        if code.startswith("return value * "):
            scales[snippet.get("name", "")] = topic.removesuffix("/data"), float(code.split()[-1])
    return scales, {curve.get("name", "").replace(TARGET, "Target") for curve in root.iter("curve")}


@pytest.mark.parametrize("shown", [of_foxglove, of_plotjuggler])
def test_each_line_is_a_topic_in_its_unit_or_the_target(
    shown: Callable[[], tuple[Scales, set[str]]]
) -> None:
    scales, labels = shown()
    displays = {topic: read_topics()[topic].display for topic in SHOWN}
    assert scales == {
        f"{display.label} ({display.unit})": (topic, display.factor)
        for topic, display in displays.items() if display is not None
    }
    assert len(scales) == len(SHOWN) and labels == {*scales, "Target"}
