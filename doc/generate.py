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
import types
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Union, get_args, get_origin
from unittest import mock

DOC = Path(__file__).resolve().parent
sys.path[:0] = [str(DOC), str(DOC.parent)]

from layouts import LAYOUTS
from layouts import rows as displays
from pictures import draw as draw_pictures
from who_publishes import WAYS, drawing

from greenroof_ros.__main__ import COMMANDS, GROUPS
from greenroof_ros.analysis.district.file import (
    District,
    DistrictWeather,
    Draw,
    Orifice,
)
from greenroof_ros.api.scenarios import read_references
from greenroof_ros.base.files import (
    default_site_file,
    parse_yaml,
    read_text,
    read_yaml,
    shared_directory,
)
from greenroof_ros.base.parameter import Parameter, parameters_of
from greenroof_ros.controllers.outlet import PARAMETERS
from greenroof_ros.controllers.registry import BUILT_IN, find_controller
from greenroof_ros.interface.alarm import Alarm
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
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.site.file import DETERMINES, SITE_KEYS, SUBSTRATES, read_site
from greenroof_ros.site.site import Site
from greenroof_ros.weather.description import Description
from greenroof_ros.weather.quantities import QUANTITIES, ROOF, known_units

_BLOCK = re.compile(
    r"(?<=<!-- table: )(?P<name>[a-z_ ]+)(?P<gap> -->\n)(?P<table>.*?)(?=<!-- end of table -->)",
    re.DOTALL,
)
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
    """Return a table; a cell that is a tuple has a line for each of its texts that is not empty."""

    def part(content: object) -> str:
        texts = content if isinstance(content, tuple) else (content,)
        return "<br>".join(filter(None, map(cell, texts)))

    names = list(header)
    lines = [f"| {' | '.join(names)} |", "|" + "---|" * len(names)]
    lines += [f"| {' | '.join(map(part, row))} |" for row in rows]
    return "\n".join(lines) + "\n"


def entries(rows: Iterable[Sequence[str]]) -> str:
    """Return a list of names, each with its type and its meaning, which may have several lines.

    The lines of a list break anywhere, while a table of long names is wider than a phone.
    """
    return "".join(
        f"- **{cell(name)}**{f' ({cell(kind)})' if kind else ''}: "
        f"{'<br>'.join(map(cell, filter(None, lines)))}\n"
        for name, kind, *lines in rows
    )


def sentences(*texts: str) -> str:
    """Return the texts that are not empty, as sentences."""
    return ". ".join(filter(None, texts))


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
    """Return the content of each topic."""
    return entries(
        (
            f"`{topic.name}`", ", ".join(filter(None, (topic.unit, kind))),
            topic.meaning,
            sentences(
                f"Published by {describe_roles(topic.publishers, topic.live_publishers)}",
                f"Read by {readers}" if readers else "",
            ),
        )
        for topic in read_topics().values()
        for kind in [topic.type.replace("/msg/", "/")]
        for readers in [describe_roles(topic.subscribers, topic.live_subscribers)]
    )


def describe_roles(simulated: Collection[str], live: Collection[str]) -> str:
    """Return who publishes or subscribes, first in a simulation, then in a live graph."""
    words = [", ".join(simulated)] if simulated else []
    return "; ".join([*words, f"live: {', '.join(live)}"] if live else words)


def quality() -> str:
    """Return range and quality of service of each topic, and how tools show it."""
    shown = {name: (label, unit) for name, label, _, unit in displays()}

    def values(topic: Topic) -> str:
        limits = topic.range.limits or "finite" if "Float64" in topic.type else "any"
        unit = "" if topic.unit == "1" or not topic.range.limits else topic.unit
        display = ", ".join(filter(None, shown.get(f"`{topic.name}`", ())))
        return f"{limits} {unit}".rstrip() + (f" (in layouts: {display})" if display else "")

    def messages(topic: Topic) -> str:
        if not topic.publishers:
            return "published with each measurement, in a live graph only"
        if not topic.per_tick:
            if "recorder" in topic.live_subscribers:
                return "published as required, recorded at a live site only"
            return "published as required, not recorded"
        if topic.needs:
            return f"only at a site with {topic.needs}"
        return "published by some controllers only" if topic.optional else ""

    def service(topic: Topic) -> str:
        qos = topic.qos
        texts = [] if qos.reliability == "reliable" else [qos.reliability.replace("_", " ")]
        texts += [] if qos.durability == "transient_local" else [qos.durability]
        texts += [] if qos.depth == 64 else [f"depth {qos.depth}"]
        texts += [f"lease {qos.lease_s:g} s"] if math.isfinite(qos.lease_s) else []
        return ", ".join(texts)

    return entries(
        (
            f"`{topic.name}`", "",
            "; ".join(filter(None, (values(topic), messages(topic), service(topic)))),
        )
        for topic in read_topics().values()
    )


# --- controllers and metrics ----------------------------------------------------------------------


_ANY = "any controller, at a site with a valve"


def controllers() -> str:
    """Return the parameters of every controller of this package, each once, and of the valve."""

    def type_of(each: Parameter) -> str:
        return "string" if each.among else "integer" if each.whole else "double"

    parts: list[str] = []
    described: dict[Parameter, str] = {}
    for name in (*BUILT_IN, _ANY):
        parameters = PARAMETERS if name == _ANY else find_controller(name).kind.parameters
        first = [each for each in parameters if described.setdefault(each, name) == name]
        parts.append(f"## {name}\n")
        parts.append(entries(
            (
                *_declared(each, type_of(each)),
                sentences(each.meaning, "May change in a run" if each.may_change else ""),
            )
            for each in first
        ))
        elsewhere = [each for each in parameters if each not in first]
        if elsewhere:
            names = ", ".join(f"`{each.name}`" for each in elsewhere)
            parts.append(f"Also, as for `{described[elsewhere[0]]}`: {names}.\n")
    return "\n".join(parts)


def _declared(parameter: Parameter, kind: str) -> tuple[str, str]:
    """Return a parameter's name, and its type, default and range."""
    default = parameter.default
    unknown = isinstance(default, float) and math.isnan(default)  # it depends on the site
    shown = f"{kind}, {parameter.unit if unknown else quantity(default, parameter.unit)}"
    return f"`{parameter.name}`", "; ".join(filter(None, (shown, parameter.limits)))


def metrics() -> str:
    """Return the metrics of a run, whose names end in their units."""
    return entries((f"`{entry.name}`", entry.label, entry.meaning) for entry in METRICS)


def events() -> str:
    """Return the columns of the table of events."""
    return entries(
        (f"`{name}`", "", text)
        for name, text in (("start", "time of the first rain"), *_attributes(Event))
    )


def site() -> str:
    """Return the parameters of a site, with the values of the paper's site."""
    paper = read_site(shared_directory() / "config" / "site.yaml")
    return entries(
        (
            f"`{entry.name}`", quantity(getattr(paper, entry.name), entry.unit),
            sentences(
                entry.meaning,
                "" if entry.default is None else f"The default is {number(entry.default)}",
            ),
        )
        for entry in parameters_of(Site)
    )


def plain_keys() -> str:
    """Return the keys of a site file in plain words."""

    def kind(entry: Parameter) -> str:
        usual = "" if entry.usual is None else f"usually {entry.usual[0]:g} to {entry.usual[1]:g}"
        return " ".join(filter(None, (usual, entry.unit))) or "name"

    return entries(
        (f"`{name}`", kind(entry), f"{entry.meaning}; determines {', '.join(names)}")
        for name, names in DETERMINES.items() for entry in [SITE_KEYS[name]]
    )


def substrates() -> str:
    """Return the named substrates, with values and sources."""
    return markdown(
        ("`substrate`", "field capacity", "wilting point", "layer (mm)", "source"),
        (
            (f"`{name}`", f"{each['field_capacity']:g}", f"{each['wilting_point']:g}",
             f"{1000 * each['drainage_storage']:g}", each["about"])
            for name, each in SUBSTRATES.items()
        ),
    )


# --- drives ---------------------------------------------------------------------------------------

# Names of the parts of a drive's file.
_DRIVE_PARTS = {
    "the file": drive_file.DriveFile,
    "`serial`": drive_file.Serial,
    "`registers`, each": drive_file.Register,
    "`sequences`": drive_file.Sequences,
    "a step of `sequences`": drive_file.Step,
    "a condition: in `status`, and `until` of a step": drive_file.RegisterCondition,
    "`status`": drive_file.StatusWord,
    "`faults`": drive_file.Codes,
    "`timeout.serial`, `timeout.tcp`": drive_file.Timeout,
    "`action` and `mode` of either": drive_file.Action,
}


_RELAY_PARTS = {
    "the file": drive_file.RelayFile,
    "`state`": drive_file.RelayState,
    "`timer`": drive_file.Timer,
    "`must`, each": drive_file.Setting,
    "`switch_on`, `switch_off`": drive_file.RelayMessage,
}


def _kind(key: Parameter) -> str:
    """Return the kinds of values that a key of a file accepts."""
    names = {
        str: "text", int: "whole number", float: "number", tuple: "list",
        bool: "true or false",
    }
    union = get_origin(key.kind) in (Union, types.UnionType)
    kinds = get_args(key.kind) if union else (key.kind,)
    return " or ".join(dict.fromkeys(
        names.get(get_origin(kind) or kind, "mapping") for kind in kinds
        if kind is not types.NoneType
    ))


def drive_files() -> str:
    """Return every key of a drive's file."""
    return _keys(_DRIVE_PARTS)


def relay_files() -> str:
    """Return every key of a relay's file."""
    return _keys(_RELAY_PARTS)


def sensors_file() -> str:
    """Return every key of a file of sensors."""
    return _keys({
        "the file": sensor_file.Sensors,
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
    """Return every key of the parts of a file."""

    def holds(key: Parameter) -> str:
        choices = (f"`{choice}`" for choice in key.among if choice)
        unit = "" if key.unit == "1" else key.unit
        limits = " ".join(filter(None, (key.range.limits, unit)))
        accepted = ", ".join(filter(None, (limits, *choices)))
        return "; ".join(filter(None, (_kind(key), accepted, "optional" * key.optional)))

    return "\n".join(
        f"### {title[0].upper()}{title[1:]}\n\n"
        + entries((f"`{key.name}`", holds(key), key.meaning) for key in parameters_of(kind))
        for title, kind in parts.items()
    )


def _files_of_drives(*, relays: bool) -> list[Path]:
    paths = sorted((shared_directory() / "config" / "drives").glob("*.yaml"))
    return [path for path in paths if ("protocol" in read_yaml(path)) is relays]


def relays() -> str:
    """Return the relays with files in the package, and what is not verified in them."""
    parts = []
    for path in _files_of_drives(relays=True):
        relay = drive_file.read_relay_file(path)
        parts += [
            f"### {path.stem}\n\n{cell(relay.make)}: {cell(relay.model)}.\n",
            "**Timer of the relay**\n",
            entries([("Set it", "", relay.timer.how_to_set)]),
            "Other settings required on the relay:\n",
            "\n".join(f"- {cell(text)}" for text in relay.set_up) + "\n",
        ]
        if relay.unverified:
            names = ", ".join(f"`{key}`" for key in relay.unverified)
            parts.append(f"Unverified keys, which are reported at startup: {names}.\n")
    return "\n".join(parts)


def drives() -> str:
    """Return the drives with files in the package, and what is not verified in them."""
    parts = []
    for path in _files_of_drives(relays=False):
        drive = drive_file.read_drive_file(path)
        parts.append(f"### {drive.path.stem}\n\n{cell(drive.make)}: {cell(drive.model)}.\n")
        ports: dict[str, list[str]] = {}
        for interface, timeout in drive.timeout.items():
            where = "drive's Ethernet port" if interface == "tcp" else "serial port"
            ports.setdefault(timeout.how_to_set, []).append(where)
        for how_to_set, where in ports.items():
            parts.append(f"**Communication timeout of the {' and the '.join(where)}**\n")
            parts.append(entries([("Set it", "", how_to_set)]))
        parts.append("Other settings required on the drive:\n")
        parts.append("\n".join(f"- {cell(text)}" for text in drive.set_up) + "\n")
        names = ", ".join(f"`{key}`" for key in drive.unverified)
        parts.append(f"Unverified keys, which are reported at startup: {names}.\n")
    return "\n".join(parts)


def pump_settings() -> str:
    """Return the settings of the pump's logic, with their defaults for the paper's site."""
    site = read_site(shared_directory() / "config" / "site.yaml")
    return entries((*_declared(entry, "double"), entry.meaning) for entry in pump_parameters(site))


def interlocks() -> str | None:
    """Return the conditions that keep the pump off or the valve closed; None without ROS 2."""
    if importlib.util.find_spec("rclpy") is None:
        return None
    from greenroof_ros.live import pump, valve, weather

    meanings, site = read_conditions(), read_site(default_site_file())
    with_valve = read_site(default_site_file().with_name("site_valve.yaml"))
    limits = {entry.name: entry for entry in (
        *valve.parameters(with_valve), *weather.parameters(site), *pump.parameters(site),
    )}

    def limit(name: str) -> str:
        return f"`{name}` ({quantity(limits[name].default, limits[name].unit).replace('`', '')})"

    def row(code: str, entry: Interlock) -> tuple[str, str, str]:
        parts = [meanings[code].meaning]
        if entry.valve or VALVE in meanings[code].by_role:
            parts.append(f"{'only' if entry.valve else 'also'} for the outlet valve")
        if entry.limit:
            parts.append(f"parameters: {', '.join(map(limit, entry.limit))}")
        if entry.by or entry.on_page:
            by = entry.by or ("~/reset" if entry.kind == LATCHED else "itself")
            parts.append(f"cleared by {by}{' or the page' * entry.on_page}")
        text = re.sub(r"(?<!`)(~/\w+|/pump/\w+)", r"`\1`", "; ".join(parts))
        return f"`{code}`", "", text

    kinds = itertools.groupby(read_interlocks().items(), lambda item: item[1].kind)
    return "\n".join(
        f"### {kind.capitalize()}\n\n{entries(itertools.starmap(row, rows))}"
        for kind, rows in kinds
    )


# What a code is about: how it begins; all interlocks are about the pump.
_SUBJECTS = {
    "Pump and outlet valve": "drive_ driver_ standstill_ stop_ valve_",
    "Inputs and sensors": "input_ sensor_ readings_ broker_ values_ devices_",
    "Forecast and weather": "forecast_ no_forecast temperature_ freezing thermometer_ gauge_",
    "Controller, recorder and nodes": "controller_ not_ peers_ node_ station_",
}


def _subject(code: str) -> str:
    """Return what a condition is about, as a heading."""
    return next(
        subject for subject, beginnings in _SUBJECTS.items()
        if code.startswith(tuple(beginnings.split()))
    )


def conditions() -> str:
    """Return each code that a status may have besides those of interlocks, by subject."""
    codes: dict[str, list[tuple[str, str, str]]] = {subject: [] for subject in _SUBJECTS}
    for code, condition in read_conditions().items():
        if condition.interlock is None:
            codes[_subject(code)].append((f"`{code}`", "", condition.meaning))
    return "\n".join(f"### {subject}\n\n{entries(rows)}" for subject, rows in codes.items())


def quantities() -> str:
    """Return the quantities of weather and roofs."""
    return markdown(
        ("column", "units", "record", "physical range"),
        (
            (
                name, ", ".join(f"`{unit}`" for unit in known_units(name)),
                "roof" if name in ROOF else "weather",
                f"{quantity.low:g} to {quantity.high:g} {quantity.unit}".removesuffix(" 1"),
            )
            for name, quantity in QUANTITIES.items()
        ),
    )


def description() -> str:
    """Return the keys of a description of a weather file."""
    return markdown(("key", "meaning"), (
        (f"`{key.name}`", key.description + (
            f": {key.limits}" if key.among else ""
        ))
        for key in parameters_of(Description) if key.name not in ("name", "header")
    ))


def plausible() -> str:
    """Return the limits of climates."""
    path = shared_directory() / "config" / "plausible.yaml"
    return markdown(("statistic", "limits", "likely mistake", "source of the limits"), (
        (
            row["statistic"],
            f"{row.get('low', '')} to {row.get('high', '')} {row['unit']}".removeprefix(" to ")
            if "low" in row else f"up to {row['high']} {row['unit']}",
            row["mistake"], row["source"],
        )
        for row in parse_yaml(read_text(path), path)
    ))


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


def alarm() -> str:
    """Return the keys of an alarm."""
    return markdown(("key", "meaning"), (
        (f"`{name}`", text) for name, text in _attributes(Alarm)
    ))


# --- commands -------------------------------------------------------------------------------------


def parser_of(name: str, arguments: Sequence[str] = ()) -> argparse.ArgumentParser:
    """Return the parser of a command's options, as it is for given arguments."""
    with mock.patch.object(sys, "argv", [name, *arguments]):
        parser: argparse.ArgumentParser = COMMANDS[name].load().make_parser()
        return parser


def command_groups() -> str:
    """Return what each command of ``greenroof`` does, grouped by the user's purpose."""
    return "\n".join(
        f"**{title[0].upper()}{title[1:]}**\n\n" + markdown(
            ("command", "what it does"),
            ((f"`{name}`", entry.about) for name, entry in group.items()),
        )
        for title, group in GROUPS.items()
    )


# --- nodes ----------------------------------------------------------------------------------------


def nodes() -> str | None:
    """Return the parameters that each node declares; None without ROS 2."""
    if importlib.util.find_spec("rclpy") is None:
        return None
    from rclpy.parameter import Parameter as RosParameter

    from greenroof_ros.live import controller as live_controller
    from greenroof_ros.live import external_pump, pump, sensors, valve
    from greenroof_ros.live import recorder as live_recorder
    from greenroof_ros.live import weather as live_weather
    from greenroof_ros.nodes import alarms, controller, plant, recorder, weather
    site = read_site(default_site_file())
    declared = {
        "plant": plant.parameters(site), "weather": weather.parameters(site),
        "recorder": recorder.parameters(site), "controllers": controller.parameters(None),
        "live_weather": live_weather.parameters(site),
        "live_controller": live_controller.parameters(None),
        "live_recorder": live_recorder.parameters(site), "sensors": sensors.parameters(site),
        "pump": pump.parameters(site), "pump_guard": external_pump.parameters(site),
        "valve": valve.parameters(read_site(default_site_file().with_name("site_valve.yaml"))),
        "alarms": alarms.parameters(site),
    }
    of_nodes: dict[tuple[str, str, str], list[str]] = {}
    for node, parameters in declared.items():
        for parameter in parameters:
            kind = RosParameter.Type.from_parameter_value(parameter.default).name
            name = kind.lower().replace("_", " ")
            row = (*_declared(parameter, name), parameter.meaning)
            of_nodes.setdefault(row, []).append(node)
    settings = {f"`{parameter.name}`" for parameter in pump_parameters(site)}
    shared = [
        (name, kind, meaning, f"Nodes: {', '.join(nodes)}")
        for (name, kind, meaning), nodes in of_nodes.items()
        if len(nodes) > 1 and name not in settings
    ]
    return "\n".join([
        "### several nodes\n\n" + entries(shared),
        *(
            f"### {node}\n\n{entries(own)}" for node in declared
            if (own := [row for row, nodes in of_nodes.items() if nodes == [node]])
        ),
    ])


def scenario_scores() -> str:
    """Return the scores of each scenario's controllers, the best first."""
    return "\n".join(
        f"**`{name}`**\n\n" + markdown(("controller", "score", "at best", "water stress"), (
            (controller, f"{score:.2f}", f"{bound:.2f}", f"{stress:.0f} h")
            for _, controller, score, bound, stress in own.sort("score", maintain_order=True).rows()
        ))
        for (name,), own in read_references().group_by("scenario", maintain_order=True)
    )


TABLES: dict[str, Callable[[], str | None]] = {
    "topics": topics,
    "quality of service": quality,
    "controllers": controllers,
    "metrics": metrics,
    "events": events,
    "site": site,
    "plain site keys": plain_keys,
    "substrates": substrates,
    "pump settings": pump_settings,
    "interlocks": interlocks,
    "conditions": conditions,
    "quantities": quantities,
    "description": description,
    "plausible": plausible,
    "alarm": alarm,
    "command groups": command_groups,
    "nodes": nodes,
    "drive file": drive_files,
    "drives": drives,
    "sensors file": sensors_file,
    "district file": district_file,
    "relay file": relay_files,
    "relays": relays,
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
