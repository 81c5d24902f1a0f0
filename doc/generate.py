"""Write the documentation's tables and drawings: ``python doc/generate.py``.

They come from the package's code and data. A page contains a table between
``<!-- table: NAME -->`` and ``<!-- end of table -->``, so it can be read without a build, and a
file of the package between ``<!-- file: PATH -->`` and ``<!-- end of file -->``. ``make docs``
writes all of them again, and a test compares them with the output of this program. The nodes'
tables need ROS 2; without it they stay unchanged. The program also writes the layouts in
``config/layouts/``, the drawings of who publishes what, and the pictures of runs.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import inspect
import itertools
import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any
from unittest import mock

DOC = Path(__file__).resolve().parent
sys.path[:0] = [str(DOC), str(DOC.parent)]

from layouts import LAYOUTS
from pictures import draw as draw_pictures
from who_publishes import WAYS, drawing

from greenroof_ros.__main__ import COMMANDS
from greenroof_ros.analysis.district.file import (
    District,
    DistrictWeather,
    Draw,
    Orifice,
)
from greenroof_ros.api.scenarios import read_references, scenarios
from greenroof_ros.base.files import (
    default_site_file,
    read_yaml,
    shared_directory,
)
from greenroof_ros.base.parameter import Parameter, parameters_of
from greenroof_ros.base.ranges import Range
from greenroof_ros.controllers.outlet import PARAMETERS
from greenroof_ros.controllers.registry import BUILT_IN, find_controller
from greenroof_ros.interface.conditions import (
    LATCHED,
    Interlock,
    read_conditions,
    read_interlocks,
)
from greenroof_ros.interface.states import VALVE
from greenroof_ros.interface.topics import Topic, read_topics
from greenroof_ros.live.devices import drive_file, sensor_file
from greenroof_ros.live.pumping.limits import pump_parameters
from greenroof_ros.physics.storm_water import Event
from greenroof_ros.results.metrics import METRICS, Metric
from greenroof_ros.site.file import DETERMINES, SITE_KEYS, read_site
from greenroof_ros.site.site import Site
from greenroof_ros.weather.description import Description
from greenroof_ros.weather.quantities import QUANTITIES, known_units

_BLOCK = re.compile(
    r"(?<=<!-- table: )(?P<name>[a-z_ ]+)(?P<gap> -->\n)(?P<table>.*?)(?=<!-- end of table -->)",
    re.DOTALL,
)
# A limit this far from 0 only excludes nonsense.
_BEYOND = 1e5
# An option, or a command with its options.
_CODE = re.compile(
    rf"\bgreenroof (?:{'|'.join(COMMANDS)})\b(?: --[a-z-]+)*|(?<![\w-])--[a-z][a-z-]*(?:=-?\d+)?"
)


def cell(text: object) -> str:
    """Return a text as the cell of a table; text in backticks is left unchanged.

    Options and commands become code.
    """
    line = " ".join(str(text).split())
    line = re.sub(r"'((?:ros2|greenroof|python) [^']*)'", r"`\1`", line)
    parts = re.split(r"(`[^`]*`)", line)
    parts[::2] = [_CODE.sub(r"`\g<0>`", part) for part in parts[::2]]
    line = "".join(parts)
    parts = re.split(r"(`[^`]*`)", line)
    parts[::2] = [re.sub(r"([|*<>$\[\]{}]|\b_|_\b)", r"\\\1", part) for part in parts[::2]]
    return "".join(parts)


def markdown(header: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a table."""
    names = list(header)
    lines = [f"| {' | '.join(names)} |", "|" + "---|" * len(names)]
    lines += [f"| {' | '.join(map(cell, row))} |" for row in rows]
    return "\n".join(lines) + "\n"


def entries(rows: Iterable[Sequence[str]]) -> str:
    """Return a list of names, each with its value and limits in parentheses, and its meaning.

    The lines of a list break anywhere, while a table of long names is wider than a phone.
    """
    return "".join(
        f"- **{cell(name)}**{f' ({cell(kind)})' if kind else ''}: {cell(meaning)}\n"
        for name, kind, meaning in rows
    )


def joined(*texts: str) -> str:
    """Return the texts that are not empty, separated by semicolons."""
    return "; ".join(filter(None, texts))


def limits(valid: Range) -> str:
    """Return the allowed values; a limit that only excludes nonsense is left out."""
    if valid.words:
        return " or ".join(f"`{each}`" for each in valid.words if each)
    return valid.limits if valid.low > -_BEYOND and valid.high < _BEYOND else ""


def number(value: object) -> str:
    """Return a number, or another value of a parameter, as a user would write it."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, (list, tuple)):
        return ", ".join(number(each) for each in value) or "none"
    if isinstance(value, str):
        shared = f"{shared_directory()}/"
        return f"`{value.removeprefix(shared)}`" if value else "empty"
    assert isinstance(value, (int, float))
    if math.isinf(value):
        return "`.inf`" if value > 0 else "`-.inf`"
    digits = f"{value:.7g}"
    whole = digits.removeprefix("-").isdecimal()
    return f"`{digits}.0`" if whole and isinstance(value, float) else f"`{digits}`"


def quantity(value: object, unit: str) -> str:
    """Return a value with its unit; ``1`` is the unit of a number without one."""
    return f"{number(value)} {'' if unit == '1' else unit}".strip()


# --- topics ---------------------------------------------------------------------------------------


def topics() -> str:
    """Return unit, range, publishers, meaning and quality of service of each topic."""
    return entries(
        (
            f"`{topic.name}`", joined(_type(topic), _values(topic), _publishers(topic)),
            joined(topic.meaning, "by some controllers only" * topic.optional, _service(topic)),
        )
        for topic in read_topics().values()
    )


def _type(topic: Topic) -> str:
    kind = topic.type.replace("/msg/", "/")
    return "" if kind == "std_msgs/Float64" else kind.removeprefix("std_msgs/")


def _values(topic: Topic) -> str:
    return " ".join(filter(None, (limits(topic.range), topic.unit.removesuffix("1"))))


def _publishers(topic: Topic) -> str:
    """Return who publishes a topic, first in a simulation, then in a live graph."""
    live = f"live: {', '.join(topic.live_publishers)}" if topic.live_publishers else ""
    return joined(", ".join(topic.publishers), live)


def _service(topic: Topic) -> str:
    qos = topic.qos
    texts = [] if qos.reliability == "reliable" else [qos.reliability.replace("_", " ")]
    texts += [] if qos.durability == "transient_local" else [qos.durability]
    texts += [] if qos.depth == 64 else [f"depth {qos.depth}"]
    texts += [f"lease {qos.lease_s:g} s"] if math.isfinite(qos.lease_s) else []
    return ", ".join(texts)


# --- controllers and metrics ----------------------------------------------------------------------


_ANY = "any controller, at a site with a valve"


def controllers() -> str:
    """Return the parameters of every controller of this package, each once, and of the valve."""
    parts: list[str] = []
    described: dict[Parameter, str] = {}
    for name in (*BUILT_IN, _ANY):
        parameters = PARAMETERS if name == _ANY else find_controller(name).kind.parameters
        first = [each for each in parameters if described.setdefault(each, name) == name]
        parts.append(f"## {name}\n")
        parts.append(entries(
            (*_declared(each), joined(each.meaning, "may change in a run" * each.may_change))
            for each in first
        ))
        elsewhere = [each for each in parameters if each not in first]
        if elsewhere:
            names = ", ".join(f"`{each.name}`" for each in elsewhere)
            parts.append(f"Also, as for `{described[elsewhere[0]]}`: {names}.\n")
    return "\n".join(parts)


def _declared(parameter: Parameter) -> tuple[str, str]:
    """Return a parameter's name, and its default and range."""
    default = parameter.default
    unknown = isinstance(default, float) and math.isnan(default)  # it depends on the site
    shown = parameter.unit if unknown else quantity(default, parameter.unit)
    return f"`{parameter.name}`", joined(shown, limits(parameter.range))


def metrics() -> str:
    """Return the metrics of a run, whose names end in their units; those of peaks are one entry."""

    def kind(entry: Metric) -> str:
        return re.sub(r"\d+min|\d+ min", "MINUTES", entry.name + entry.meaning)

    def meaning(group: list[Metric]) -> str:
        times = (found[0] for entry in group if (found := re.search(r"\d+(?= min)", entry.meaning)))
        return re.sub(r"\d+(?= min)", ", ".join(dict.fromkeys(times)), group[0].meaning)

    groups = [list(group) for _, group in itertools.groupby(METRICS, kind)]
    return entries(
        (", ".join(f"`{entry.name}`" for entry in group), "", meaning(group)) for group in groups
    )


def events() -> str:
    """Return the columns of the table of events."""
    return entries(
        (f"`{name}`", "", text)
        for name, text in (("start", "time of the first rain"), *_attributes(Event))
    )


def site() -> str:
    """Return the optional parameters of a site that the paper's site file does not explain."""
    path = shared_directory() / "config" / "site.yaml"
    paper, explained = read_site(path), read_yaml(path)
    return entries(
        (
            f"`{entry.name}`", quantity(getattr(paper, entry.name), entry.unit), entry.meaning,
        )
        for entry in parameters_of(Site) if entry.name not in explained
    )


def plain_keys() -> str:
    """Return the keys of a site file in plain words, with usual values."""

    def kind(entry: Parameter) -> str:
        usual = "" if entry.usual is None else f"usually {entry.usual[0]:g} to {entry.usual[1]:g}"
        return " ".join(filter(None, (usual, entry.unit)))

    return entries(
        (f"`{name}`", kind(entry), entry.meaning)
        for name in DETERMINES for entry in [SITE_KEYS[name]]
    )


# --- drives ---------------------------------------------------------------------------------------

# Names of the parts of a drive's file.
_DRIVE_PARTS = {
    "the file": drive_file.DriveFile,
    "`registers`, each": drive_file.Register,
    "`sequences`": drive_file.Sequences,
    "a step of `sequences`": drive_file.Step,
    "a condition: in `status`, and `until` of a step": drive_file.RegisterCondition,
    "`status`": drive_file.StatusWord,
    "`faults`": drive_file.Codes,
    "`timeout.serial`, `timeout.tcp`": drive_file.Timeout,
    "`action` and `mode` of either": drive_file.Action,
}


def drive_files() -> str:
    """Return the keys of a drive's file."""
    return _keys(_DRIVE_PARTS)


def sensors_file() -> str:
    """Return the keys of each sensor in a file of sensors."""
    return _keys({
        "a sensor on Modbus": sensor_file.ModbusSensor,
        "a sensor on MQTT": sensor_file.MqttSensor,
    })


def district_file() -> str:
    """Return every key of a district's file."""
    return _keys({
        "the file": District, "`weather`": DistrictWeather, "`draw`, each": Draw,
        "`orifice`": Orifice,
    })


def _keys(parts: Mapping[str, Any]) -> str:
    """Return the keys of the parts of a file, without those inherited as in an earlier part."""

    def values(key: Parameter) -> str:
        nothing = key.default in ("", -math.inf, math.inf)
        stated = isinstance(key.default, (int, float, str)) and not nothing
        default = f"default {number(key.default)}" if stated else "optional"
        return joined(_limits_with_unit(key), default if key.optional else "")

    texts, earlier = [], list[type]()
    for title, kind in parts.items():
        inherited = {
            each.name for base in kind.__mro__ if is_dataclass(base)
            and any(issubclass(other, base) for other in earlier) for each in fields(base)
        }
        earlier.append(kind)
        texts.append(f"### {title[0].upper()}{title[1:]}\n\n" + entries(
            (f"`{key.name}`", values(key), key.meaning)
            for key in parameters_of(kind) if key.name not in inherited
        ))
    return "\n".join(texts)


def _limits_with_unit(key: Parameter) -> str:
    return " ".join(filter(None, (limits(key.range), "" if key.unit == "1" else key.unit)))


def drives() -> str:
    """Return the drives and relays with files in the package."""
    paths = sorted((shared_directory() / "config" / "drives").glob("*.yaml"))
    files = [(path.stem, read_yaml(path)) for path in paths]
    return entries((f"`{name}`", "", f"{file['make']}: {file['model']}") for name, file in files)


def pump_settings() -> str:
    """Return the settings of the pump's logic, with their defaults for the paper's site."""
    site = read_site(shared_directory() / "config" / "site.yaml")
    return entries((*_declared(entry), entry.meaning) for entry in pump_parameters(site))


def interlocks() -> str:
    """Return the conditions that keep the pump off or the valve closed."""
    meanings = read_conditions()

    def row(code: str, entry: Interlock) -> tuple[str, str, str]:
        also = "also valve" * (VALVE in meanings[code].by_role)
        text = meanings[code].meaning
        if entry.by or entry.on_page:
            by = entry.by or ("~/reset" if entry.kind == LATCHED else "itself")
            text += f"; cleared by {by}{' or the page' * entry.on_page}"
        text = re.sub(r"(?<!`)(~/\w+|/pump/\w+)", r"`\1`", text)
        names = ", ".join(f"`{name}`" for name in entry.limit)
        return f"`{code}`", joined("valve only" if entry.valve else also, names), text

    kinds = itertools.groupby(read_interlocks().items(), lambda item: item[1].kind)
    return "\n".join(
        f"### {kind.capitalize()}\n\n{entries(itertools.starmap(row, rows))}"
        for kind, rows in kinds
    )


def quantities() -> str:
    """Return the quantities of weather and roofs, with their units."""
    by_units: dict[tuple[str, ...], list[str]] = {}
    for name in QUANTITIES:
        by_units.setdefault((*known_units(name),), []).append(name)
    return markdown(("column", "units"), (
        (", ".join(names), " ".join(f"`{unit}`" for unit in units))
        for units, names in by_units.items()
    ))


def description() -> str:
    """Return the keys of a description of a weather file."""
    return entries(
        (f"`{key.name}`", "" if key.name == "sep" else _limits_with_unit(key), key.meaning)
        for key in parameters_of(Description) if key.name not in ("name", "header")
    )


def _attributes(kind: type) -> list[tuple[str, str]]:
    """Return the attributes in a class's docstring, with their meanings."""
    described = inspect.cleandoc(kind.__doc__ or "").partition("Attributes:\n")[2]
    entire = re.sub(r"\n {8,}", " ", described)  # an entry may continue on further lines
    pairs = (line.strip().partition(": ") for line in entire.splitlines())
    return [(name, _json_words(text)) for name, _, text in pairs]


def _json_words(text: str) -> str:
    """Return what a docstring states about an attribute, as the meaning of a key in JSON."""
    for before, after in (("``", "`"), (r"\bNone\b", "`null`"), (r"; from :mod:`[^`]*`", "")):
        text = re.sub(before, after, text)
    return text.rstrip(".")


# --- commands -------------------------------------------------------------------------------------


def parser_of(name: str, arguments: Sequence[str] = ()) -> argparse.ArgumentParser:
    """Return the parser of a command's options, as it is for given arguments."""
    with mock.patch.object(sys, "argv", [name, *arguments]):
        parser: argparse.ArgumentParser = COMMANDS[name].load().make_parser()
        return parser


def commands() -> str:
    """Return what each command of ``greenroof`` does."""
    rows = ((f"`{name}`", entry.about) for name, entry in COMMANDS.items())
    return markdown(("command", "what it does"), rows)


# --- nodes ----------------------------------------------------------------------------------------


def nodes() -> str | None:
    """Return the parameters that each node declares; None without ROS 2."""
    if importlib.util.find_spec("rclpy") is None:
        return None
    from greenroof_ros.live import controller as live_controller
    from greenroof_ros.live import external_pump, pump, station, valve
    from greenroof_ros.live import recorder as live_recorder
    from greenroof_ros.live import weather as live_weather
    from greenroof_ros.live.live_input import LIMITS
    from greenroof_ros.nodes import alarms, controller, plant, recorder, weather
    site = read_site(default_site_file())
    declared = {
        "plant": plant.parameters(site), "weather": weather.parameters(site),
        "recorder": recorder.parameters(site), "controllers": controller.parameters(None),
        "live_weather": live_weather.parameters(site),
        "live_controller": live_controller.parameters(None),
        "live_recorder": live_recorder.parameters(site), "sensors": station.parameters(site),
        "pump": pump.parameters(site), "pump_guard": external_pump.parameters(site),
        "valve": valve.parameters(read_site(default_site_file().with_name("site_valve.yaml"))),
        "alarms": alarms.parameters(site),
    }
    settings = {parameter.name for parameter in pump_parameters(site)}
    options = {
        action.dest for command in ("run", "live") for action in parser_of(command)._actions
    }
    of_nodes: dict[tuple[str, str, str], list[str]] = {}
    same, ages = set(), set()
    for node, parameters in declared.items():
        for each in parameters:
            if each.name in options:
                same.add(f"`{each.name}`")
            elif each in LIMITS.values():
                ages.add(f"`{each.name}` ({each.default:g} s)")
            elif node == "valve" or each.name not in settings:
                of_nodes.setdefault((*_declared(each), each.meaning), []).append(node)
    return entries(
        (name, joined(values, ", ".join(nodes)), meaning)
        for (name, values, meaning), nodes in of_nodes.items()
    ) + (
        f"\nMaximum ages of live inputs: {', '.join(sorted(ages))}.\n"
        f"\nLike the options of `greenroof run` and `live`: {', '.join(sorted(same))}.\n"
    )


def scenario_scores() -> str:
    """Return the scores of the controllers, in a table for each unit of the scores."""
    references: dict[str, dict[str, str]] = {}
    for scenario, controller, score, bound, stress in read_references().iter_rows():
        rows = references.setdefault(scenario, {"at best": f"{bound:.2f}"})
        rows[controller] = f"{score:.2f}" + f" ({stress:.0f} h)" * (stress > 0)
    texts = []
    for unit in dict.fromkeys(each.unit for each in scenarios.values()):
        columns = {name: rows for name, rows in references.items() if scenarios[name].unit == unit}
        controllers = dict.fromkeys(itertools.chain.from_iterable(columns.values()))
        texts.append(markdown((f"score ({unit})", *columns), (
            (controller, *(rows.get(controller, "") for rows in columns.values()))
            for controller in controllers
        )))
    return "\n".join(texts)


TABLES: dict[str, Callable[[], str | None]] = {
    "topics": topics,
    "controllers": controllers,
    "metrics": metrics,
    "events": events,
    "site": site,
    "plain site keys": plain_keys,
    "pump settings": pump_settings,
    "interlocks": interlocks,
    "quantities": quantities,
    "description": description,
    "commands": commands,
    "nodes": nodes,
    "drive file": drive_files,
    "drives": drives,
    "sensors file": sensors_file,
    "district file": district_file,
    "scenarios": scenario_scores,
}


_FILE = re.compile(
    r"(?<=<!-- file: )(?P<path>\S+)(?: lines (?P<first>\d+)-(?P<last>\d+))? -->\n.*?"
    r"(?=<!-- end of file -->)",
    re.DOTALL,
)
LANGUAGES = {".yaml": "yaml", ".py": "python", ".service": "ini", ".csv": "text"}


def excerpt(match: re.Match[str]) -> str:
    """Return a file of the package, or some of its lines, as a block of code."""
    path = DOC.parent / match["path"]
    lines = path.read_text(encoding="utf-8").splitlines()
    which = ""
    if match["first"] is not None:
        lines = lines[int(match["first"]) - 1 : int(match["last"])]
        which = f" lines {match['first']}-{match['last']}"
    code = "\n".join(lines)
    return f"{match['path']}{which} -->\n```{LANGUAGES[path.suffix]}\n{code}\n```\n"


def renew(page: str) -> str:
    """Return a page with its tables and its excerpts of files written again."""

    def table(match: re.Match[str]) -> str:
        made = TABLES[match["name"]]()
        text = match["table"] if made is None else f"\n{made}\n"
        return f"{match['name']}{match['gap']}{text}"

    return _FILE.sub(excerpt, _BLOCK.sub(table, page))


def main() -> None:
    """Write all pages' tables, the layouts and the drawings."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    for path in (DOC.parent / "README.md", *sorted(DOC.rglob("*.md"))):
        before = path.read_text(encoding="utf-8")
        after = renew(before)
        if after != before:
            path.write_text(after, encoding="utf-8")
            print(f"written: {path.relative_to(DOC.parent)}")
    for name, layout in LAYOUTS.items():
        path = DOC.parent / "config" / "layouts" / name
        path.write_text(layout(), encoding="utf-8")
    for name, way in WAYS.items():
        (DOC / "_static" / f"{name}.svg").write_text(drawing(way), encoding="utf-8")
    draw_pictures()


if __name__ == "__main__":
    main()
