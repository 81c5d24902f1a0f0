"""The layouts in config/layouts/, compared with the interface."""

from __future__ import annotations

import json
import math
import re
import sys
from xml.etree import ElementTree

import pytest
from places import CHECKOUT, CONFIG

from greenroof_ros.common.interface import read_topics
from greenroof_ros.model.site import read_site

sys.path.append(str(CHECKOUT / "doc"))

from layouts import LAYOUTS

FOXGLOVE = CONFIG / "layouts" / "greenroof.foxglove.json"
PLOTJUGGLER = CONFIG / "layouts" / "greenroof.plotjuggler.xml"
SHOWN = {
    "/roof/level", "/cistern/level", "/pump/command", "/pump/flow", "/pump/meter",
    "/weather/precipitation", "/weather/evapotranspiration", "/gauge/precipitation",
    "/roof/drainage", "/cistern/outflow",
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts_are_made_from_the_interface(name: str) -> None:
    """'make docs' would write nothing else."""
    assert (CONFIG / "layouts" / name).read_text(encoding="utf-8") == LAYOUTS[name]()


def check_scale(topic: str, label: str, factor: float) -> None:
    """Check a topic against the interface: a number, with this label, its unit and this factor."""
    entry = read_topics()[topic]
    assert entry.type == "std_msgs/msg/Float64"
    assert entry.display is not None
    assert label == f"{entry.display.label} ({entry.display.unit})"
    assert factor == entry.display.factor


def target() -> float:
    """Return the target of the roof's level (mm)."""
    return read_site(CONFIG / "site.yaml").z_veg * 1000


def test_foxglove() -> None:
    """Each line shows a script's output, and each script scales a topic."""
    layout = json.loads(FOXGLOVE.read_text(encoding="utf-8"))
    outputs = {}
    for script in layout["userNodes"].values():
        (topic,) = re.findall(r'^export const inputs = \["(.+)"\];$', script["sourceCode"], re.M)
        (output,) = re.findall(r'^export const output = "(.+)";$', script["sourceCode"], re.M)
        (factor,) = re.findall(r"event\.message\.data \* ([\d.]+)\)", script["sourceCode"])
        assert output.startswith("/studio_script/")
        check_scale(topic, script["name"], float(factor))
        outputs[f"{output}.value"] = topic, script["name"]
    assert {topic for topic, _ in outputs.values()} == SHOWN
    lines = [
        line for panel in layout["configById"].values() for line in panel.get("paths", [])
    ]
    drawn = {line["value"]: line["label"] for line in lines}
    assert len(drawn) == len(lines)
    (goal,) = drawn.keys() - outputs.keys()
    assert math.isclose(float(goal), target()) and drawn.pop(goal) == "Target"
    assert drawn == {path: name for path, (_, name) in outputs.items()}
    assert layout["configById"]["DiagnosticSummary!greenroof"]["topicToRender"] in read_topics()


def test_plotjuggler() -> None:
    """Each curve shows a function's output, and each function scales a topic."""
    root = ElementTree.parse(PLOTJUGGLER).getroot()
    functions = {}
    for snippet in root.iterfind("customMathEquations/snippet"):
        topic, _, field = snippet.findtext("linked_source", "").rpartition("/")
        assert field == "data"
        functions[snippet.get("name", "")] = topic, snippet.findtext("function", "")
    curves = [curve.get("name", "") for curve in root.iter("curve")]
    assert sorted(curves) == sorted(functions)
    _, goal = functions.pop("Target (mm)")
    assert math.isclose(float(goal.removeprefix("return ")), target())
    for name, (topic, code) in functions.items():
        check_scale(topic, name, float(code.removeprefix("return value * ")))
    assert {topic for topic, _ in functions.values()} == SHOWN
