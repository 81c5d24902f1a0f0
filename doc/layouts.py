"""Layouts of Foxglove or Lichtblick, and of PlotJuggler, made from ``msg_defs/topics.yaml``.

Both show a topic's values in the unit of its ``display``. Plots cannot scale values in either
program, so each topic gets a user script in Foxglove, which publishes its own topic, and a custom
function in PlotJuggler, which makes a series.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

from greenroof_ros.base.files import shared_directory
from greenroof_ros.interface.topics import Display, read_topics
from greenroof_ros.site.file import read_site


@dataclass(frozen=True)
class Panel:
    """A plot.

    Attributes:
        title: its title.
        topics: the topics that it shows, each a number.
        target: whether it also shows the target of the roof's level.
    """

    title: str
    topics: tuple[str, ...]
    target: bool = False


PANELS = (
    Panel("Roof level", ("/roof/level",), target=True),
    Panel("Pump and valve", ("/pump/command", "/pump/flow", "/pump/meter", "/outlet/command")),
    Panel("Cistern level", ("/cistern/level",)),
    Panel(
        "Weather", ("/weather/precipitation", "/weather/evapotranspiration", "/gauge/precipitation")
    ),
    Panel("Water that leaves", ("/roof/drainage", "/cistern/outflow", "/outlet/flow")),
)
# Prefix of the topics of user scripts in Foxglove.
SCRIPTS = "/studio_script"
# From the default categorical colours of both programs; the last is for the target.
_COLOURS, _TARGET = ("#1f77b4", "#ff7f0e", "#2ca02c", "#9467bd"), "#d62728"


def display_of(topic: str) -> Display:
    """Return how the values of a topic with a unit are shown."""
    display = read_topics()[topic].display
    assert display is not None, topic
    return display


def label(topic: str) -> str:
    """Return the label of a topic's line: ``Roof level (mm)``."""
    display = display_of(topic)
    return f"{display.label} ({display.unit})"


def target() -> float:
    """Return the target of the roof's level as shown, from the package's site file."""
    site = read_site(shared_directory() / "config" / "site.yaml")
    return round(site.z_veg * display_of("/roof/level").factor, 6)


# --- Foxglove, Lichtblick -------------------------------------------------------------------------


def foxglove() -> str:
    """Return the layout that Foxglove and Lichtblick import."""
    plots = {f"Plot!greenroof{number}": _plot(panel) for number, panel in enumerate(PANELS, 1)}
    summary = "DiagnosticSummary!greenroof"
    roof, pump, cistern, weather, water = plots
    layout = {
        "configById": {
            **plots,
            summary: {
                "minLevel": 0, "pinnedIds": [], "hardwareIdFilter": "",
                "topicToRender": "/diagnostics", "sortByLevel": True, "secondsUntilStale": 5,
            },
        },
        "globalVariables": {},
        "userNodes": {
            topic.strip("/").replace("/", "_"): {"name": label(topic), "sourceCode": _script(topic)}
            for panel in PANELS for topic in panel.topics
        },
        "playbackConfig": {"speed": 1},
        # The statuses have the whole width: each begins with its hardware's name.
        "layout": _split("column", 78, _split(
            "row", 50,
            _split("column", 50, roof, pump),
            _split("column", 28, cistern, _split("column", 56, weather, water)),
        ), summary),
    }
    return json.dumps(layout, indent=1, ensure_ascii=False) + "\n"


def _plot(panel: Panel) -> dict[str, Any]:
    lines = [
        _line(f"{SCRIPTS}{topic}.value", label(topic), colour)
        for topic, colour in zip(panel.topics, _COLOURS, strict=False)
    ]
    if panel.target:
        lines.append(_line(f"{target():g}", "Target", _TARGET))
    return {
        # The title's key in Foxglove, and in Lichtblick.
        "foxglovePanelTitle": panel.title,
        "lichtblickPanelTitle": panel.title,
        "paths": lines,
        # Left of the plot, where it covers no line. Its width (px) shrinks with the panel.
        "showLegend": True,
        "legendDisplay": "left",
        "sidebarDimension": 400,
        "showPlotValuesInLegend": True,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "isSynced": True,
        "xAxisVal": "timestamp",
        "minYValue": 0,
    }


def _line(path: str, name: str, colour: str) -> dict[str, Any]:
    return {
        "value": path, "label": name, "color": colour, "enabled": True, "showLine": True,
        "timestampMethod": "receiveTime",
    }


def _script(topic: str) -> str:
    """Return a script that scales a topic, to three decimals, as the legend shows them all."""
    display = display_of(topic)
    return f"""\
// {display.label} in {display.unit}, from {read_topics()[topic].unit}.
export const inputs = ["{topic}"];
export const output = "{SCRIPTS}{topic}";

export default function script(event: {{ message: {{ data: number }} }}): {{ value: number }} {{
  return {{ value: Number((event.message.data * {display.factor:.15g}).toFixed(3)) }};
}}
"""


def _split(direction: str, share: int, first: object, second: object) -> dict[str, object]:
    return {
        "direction": direction, "first": first, "second": second, "splitPercentage": share,
    }


# --- PlotJuggler ----------------------------------------------------------------------------------


def plotjuggler() -> str:
    """Return the layout that PlotJuggler loads."""
    root = ElementTree.Element("root")
    widget = _add(root, "tabbed_widget", parent="main_window", name="Main Window")
    tab = _add(widget, "Tab", tab_name="Green roof", containers="1")
    columns = _dock(_add(tab, "Container"), "|", 2)
    for panels in (PANELS[:2], PANELS[2:]):
        rows = _dock(columns, "-", len(panels))
        for panel in panels:
            _draw(rows, panel)
    _add(widget, "currentTabIndex", index="0")
    _add(root, "use_relative_time_offset", enabled="1")
    functions = _add(root, "customMathEquations")
    for topic in [topic for panel in PANELS for topic in panel.topics]:
        _function(functions, label(topic), topic, f"return value * {display_of(topic).factor:.15g}")
    _function(functions, _target_name(), "/roof/level", f"return {target():g}")
    _add(root, "snippets")
    ElementTree.indent(root, " ")
    text = ElementTree.tostring(root, encoding="unicode")
    return f"<?xml version='1.0' encoding='UTF-8'?>\n{text}\n"


def _target_name() -> str:
    return f"Target ({display_of('/roof/level').unit})"


def _draw(rows: ElementTree.Element, panel: Panel) -> None:
    area = _add(rows, "DockArea", name=panel.title)
    plot = _add(area, "plot", style="Lines", mode="TimeSeries", flip_x="false", flip_y="false")
    _add(plot, "limitY", min="0")
    for topic, colour in zip(panel.topics, _COLOURS, strict=False):
        _add(plot, "curve", name=label(topic), color=colour)
    if panel.target:
        _add(plot, "curve", name=_target_name(), color=_TARGET)


def _dock(parent: ElementTree.Element, orientation: str, count: int) -> ElementTree.Element:
    sizes = ";".join([f"{1 / count:.6f}"] * count)
    return _add(parent, "DockSplitter", orientation=orientation, sizes=sizes, count=str(count))


def _function(functions: ElementTree.Element, name: str, topic: str, code: str) -> None:
    """Add a series computed from a topic's values, which PlotJuggler calls ``TOPIC/data``."""
    snippet = _add(functions, "snippet", name=name)
    _add(snippet, "global")
    _add(snippet, "function").text = code
    _add(snippet, "linked_source").text = f"{topic}/data"


def _add(above: ElementTree.Element, tag: str, **attributes: str) -> ElementTree.Element:
    return ElementTree.SubElement(above, tag, attributes)


LAYOUTS = {"greenroof.foxglove.json": foxglove, "greenroof.plotjuggler.xml": plotjuggler}
