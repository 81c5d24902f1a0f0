"""A run in a report: its row of the table, and what its directory contains about it."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime, tzinfo
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import YamlMapping, read_text, read_yaml
from greenroof_ros.common.times import hours_minutes, hours_minutes_seconds, to_people
from greenroof_ros.experiment import summary
from greenroof_ros.experiment.incidents import INCIDENTS, Incident, read_incidents, with_incidents
from greenroof_ros.forecast.choice import OPTIONS, PERFECT
from greenroof_ros.formats.records import name_files
from greenroof_ros.model.initial_state import INITIAL_STATES
from greenroof_ros.model.metrics import METRICS, NEAR_TARGET
from greenroof_ros.model.sensor_pump_errors import PARAMETERS
from greenroof_ros.model.site import Site
from greenroof_ros.recording.bag_reader import RecordedTrajectory
from greenroof_ros.recording.results_table import shortest, summary_columns
from greenroof_ros.weather.series import REFUSE

NO_ERRORS = "none"
"""label of runs without sensor and pump errors"""

PAPERS_CONTROLLERS = {"mpc": "MPC", "onoff": "on/off"}

_PARAMETERS = "configuration/parameters.yaml"
# The most changes of parameters that a run's label and notes list: the newest.
_CHANGES = 10
# How an unfinished run ended, as a sentence and in short, by the status in its summary.
_NOT_DONE = {
    "failed": ("failed", "failed"),
    "interrupted": ("was interrupted", "interrupted"),
    "running": ("has not ended, or bringup was killed", "not ended"),
}

Row = dict[str, Any]
"""a run's row of the table"""

Parameters = dict[str, "float | str"]


@dataclass(frozen=True)
class Assumptions:
    """Assumptions that runs do not state.

    Attributes:
        energy_price: of a kWh of electric energy.
        water_price: of a m3 from the mains.
        currency: of both prices.
        band: half width of the band about the target, as a share of the target (1).
    """

    energy_price: float = 0.115
    water_price: float = 4.1346
    currency: str = "CAD"
    band: float = NEAR_TARGET


class Note(NamedTuple):
    """Something that a reader should know about a run."""

    text: str
    """the note on a single run"""
    of_many: str = ""
    """the note on several runs, without the number that differs; empty if ``text`` has none"""
    listed: str = ""
    """the items that it is about; the page folds them away"""


@dataclass(frozen=True, kw_only=True)
class ReportedRun:
    """A run as its files describe it; the defaults stand for anything that they lack.

    Attributes:
        site: the site, Table I.
        row: its row of the table: the columns of a study's ``results.csv`` and of :func:`labels`.
            The row of a bag lacks the results that are computed from the bag.
        parameters: the controller's at the start; an infinite bound has no entry.
        exact_sensor: whether the roof's recorded level is the true one.
        zone: offset from UTC; None if unknown.
        own: whether it is a simulation by this package.
        external_pump: whether a pump driver reported its pump flow.
        changes: the values that a parameter took during the run, as text to follow its first value.
        ending: how an unfinished run ended, as a sentence without subject and full stop.
        short: the same in a few words.
        incidents: losses that did not end the run; only the newest if there were very many.
        notes: what a reader should know about it.
        load: reads the trajectory, with further notes; None if no trajectory was kept.
        bound: returns the minimum total deviation (m3) that a controller with commands up to 1
            could reach in a recorded run, or None if unknown. None if the row has the bound.
        source: the study or run directory that it is from, by a unique name.
        meant: what a name in the row stands for, by column. It shows whether two sources use a
            name for different things.
    """

    site: Site
    row: Row = field(default_factory=lambda: {
        "controller": "unknown", "weather": "as recorded", "evapotranspiration": "unknown",
        "gaps": REFUSE,
    })
    parameters: Parameters = field(default_factory=dict)
    exact_sensor: bool = True
    zone: tzinfo | None = None
    own: bool = False
    external_pump: bool = False
    changes: Mapping[str, str] = field(default_factory=dict)
    ending: str = ""
    short: str = summary.DONE
    incidents: tuple[Incident, ...] = ()
    notes: tuple[Note, ...] = ()
    load: Callable[[], RecordedTrajectory] | None = None
    bound: Callable[[RecordedTrajectory], float | None] | None = None
    source: str = ""
    meant: Mapping[str, object] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the run, unique in the report."""
        return str(self.row["run"])

    @property
    def incident_count(self) -> int:
        """Number of incidents, including those not kept: they are numbered from 1."""
        return max((incident.number for incident in self.incidents), default=0)

    @property
    def ended(self) -> str:
        """How it ended in a few words, with the number of incidents."""
        return with_incidents(self.short, self.incident_count)


def controller_name(name: str) -> str:
    """Return the display name of a controller."""
    return " ".join(PAPERS_CONTROLLERS.get(word, word) for word in name.split("_"))


def parameter_text(value: float | str | None) -> str:
    """Return a parameter's value as a person writes it: 0.00001, not 1e-05."""
    if not isinstance(value, float):
        return value or "none"
    plain = 1e-7 < abs(value) < 1e7
    return np.format_float_positional(value, trim="-") if plain else shortest(value)


def parameters(cells: Mapping[str, object]) -> Parameters:
    """Return the parameters that are set: neither blank cells nor infinite bounds."""
    values: Parameters = {}
    for key, cell in cells.items():
        try:
            value = float(str(cell))
        except ValueError:
            if cell not in (None, ""):
                values[key] = str(cell)
        else:
            if math.isfinite(value):
                values[key] = value
    return values


def labels(row: Row) -> Row:
    """Return the columns that describe a run in words, from the columns of ``results.csv``.

    They are ``from`` (the initial state), ``length``, ``forecast``, ``model`` (the forecast with
    its number of members only), ``kind of forecast`` (all but the seed), ``skill``, ``seed`` and
    ``sensor and pump errors``.
    """
    options = {option: row.get(f"forecast_{option}") for option in OPTIONS}
    errors = {name: float(row.get(name) or 0) for name in PARAMETERS}
    seed = errors.pop("noise_seed")
    texts = [
        f"{name.replace('_', ' ')} {shortest(value)} {'m' if name.startswith('roof') else 's'}"
        for name, value in errors.items() if value
    ]
    if errors["roof_noise"]:
        texts.append(f"seed {shortest(seed)}")
    forecast = row.get("forecast")
    return {
        "from": _initial(row),
        "length": f"{shortest(round(row['hours'], 5))} h" if "hours" in row else "",
        "forecast": _forecast(forecast, options),
        "model": _forecast(forecast, {"members": options["members"]}),
        "kind of forecast": _forecast(forecast, {**options, "seed": None}),
        "skill": str(options["skill"] or ""),
        "seed": "" if options["seed"] is None else str(options["seed"]),
        "sensor and pump errors": ", ".join(texts) or NO_ERRORS,
    }


def _initial(row: Row) -> str:
    """Return the name of an initial state, or its volumes if it has no name."""
    if row.get("initial") is None:
        return "as recorded"
    named = row["initial"] not in ("", "custom")
    return row["initial"] if named else f"{row['cistern_m3']:.4g} / {row['roof_m3']:.4g} m3"


def meaning_of_initial(row: Row) -> object:
    """Return what an initial state means: a name of Table II, which fits any site, or volumes."""
    name = row.get("initial")
    return name if name in INITIAL_STATES else (row.get("cistern_m3"), row.get("roof_m3"))


def _forecast(name: str | None, options: Mapping[str, object]) -> str:
    """Return a name for forecasts, with the options that are set."""
    texts = [
        f"{option} {value}" for option, value in options.items() if value not in (None, "")
    ]
    return PERFECT if not name or name == PERFECT else " ".join([Path(name).name, *texts])


def notes_of(row: Row) -> list[Note]:
    """Return the notes that a row gives on its run, in addition to the results."""
    notes = []
    if row.get("filled_hours"):
        notes.append(Note(
            f"{row['filled_hours']:g} hours of the weather from {row.get('start') or 'its start'} "
            "were missing and filled in", listed=row.get("filled") or "",
        ))
    for column, text in (
        ("weather_notes", "{}"),
        ("suspicious", "suspicious, and not changed: {}"),
        ("fallbacks", "the controller's solver found no solution in {:g} ticks"),
        ("limited_steps", "a tank ran empty in {:g} ticks, and what left it was limited"),
        ("forecast_repeats_from", "a forecast ends at {}; later values are assumed"),
    ):
        if row.get(column):
            of_many = text.replace("{:g}", "some") if "{:g}" in text else ""
            notes.append(Note(text.format(row[column]), of_many))
    return notes


def read_about(run: Path, site: Site) -> ReportedRun:
    """Read a run's summary or, if it is missing or damaged, the parameters of its nodes.

    A damaged or foreign file next to a bag leaves a note; the bag is still used. Incidents have a
    file of their own, which exists before the summary lists them.
    """
    about, notes = ReportedRun(site=site), list[Note]()
    incidents: tuple[Incident, ...] = ()

    def unused(name: str, wrong: str, reason: object) -> None:
        text = str(reason).removeprefix(f"{run / name}").lstrip(":, ")
        notes.append(Note(f"{name} next to the bag is {wrong}, and not used: {text}"))

    try:
        incidents = tuple(read_incidents(run))
    except (OSError, ValueError) as error:
        unused(INCIDENTS, "damaged", error)
    for name, read in ((summary.SUMMARY, _summary), (_PARAMETERS, _node_parameters)):
        if (run / name).is_file():
            try:
                about = _understand(read(run / name), site)
            except (ConfigurationError, json.JSONDecodeError) as error:
                unused(name, "damaged or foreign", error)
            except Exception:  # a foreign file can be wrong in any way
                unused(name, "damaged or foreign", "it lacks what a run writes about itself")
            else:
                break
    return replace(
        about, external_pump=about.own and _external_pump(run), notes=(*notes, *about.notes),
        incidents=incidents or about.incidents,
    )


def _summary(file: Path) -> Any:
    return json.loads(read_text(file))


def _external_pump(run: Path) -> bool:
    """Whether a run's node parameters state that the pump flow came from a pump driver."""
    try:
        return bool(_nodes(run / _PARAMETERS)["plant"]["pump"] == "external")
    except Exception:  # no such file, or a foreign one, which can be wrong in any way
        return False


def _nodes(file: Path) -> dict[str, YamlMapping]:
    """Return the parameters of a run's nodes, by node name."""
    return {
        key.removeprefix("/**/"): section["ros__parameters"]
        for key, section in read_yaml(file).items()
    }


def _node_parameters(file: Path) -> dict[str, Any]:
    """Return the parameters of a run's nodes in the form of a summary."""
    nodes = defaultdict(YamlMapping, _nodes(file))
    plant, weather = nodes["plant"], nodes["weather"]
    controller = nodes["recorder"].get("controller")
    given = nodes[str(controller)]
    volumes = {f"{name}_m3": plant.get(f"initial_{name}_volume") for name in ("cistern", "roof")}
    return {
        "controller": controller,
        "parameters": {key: value for key, value in given.items() if key != "site_file"},
        "weather": name_files([Path(file) for file in weather.get("weather_files") or []]),
        "evapotranspiration_method": weather.get("evapotranspiration"),
        "gaps": weather.get("gaps"),
        "forecast": {
            "model": weather.get("forecast"),
            **{option: weather.get(f"forecast_{option}") for option in OPTIONS},
        },
        "sensor_pump_errors": {name: plant.get(name) for name in PARAMETERS},
        "initial": None if None in volumes.values() else volumes,
        "start": plant.get("start"),
    }


def _understand(content: dict[str, Any], site: Site) -> ReportedRun:
    """Return the run that a summary describes.

    Raises:
        Exception: of any kind, if the content is no summary.
    """
    if not isinstance(content["controller"], str):
        raise TypeError
    live = "drive_at" in content
    done = content.get("status", summary.DONE) == summary.DONE
    given = parameters(content.get("parameters") or {})
    errors = content.get("sensor_pump_errors") or {}
    row = {**ReportedRun(site=site).row, **_row(content, live=live, done=done), **errors}
    start = datetime.fromisoformat(content["start"]) if content.get("start") else None
    notes = notes_of({**row, "start": None if start is None else to_people(start)})
    changes, ticks = dict[str, str](), dict[str, list[str]]()
    listed = content.get("parameter_changes") or []
    left_out = int(content.get("parameter_change_count") or len(listed)) - _CHANGES
    for change in listed[-_CHANGES:]:
        name, value = str(change["parameter"]), change["value"]
        if name not in changes and change["before"] != given.get(name):  # earlier ones are left out
            changes[name] = f" -> ... -> {parameter_text(change['before'])}"
        became = parameter_text(None if value is None else float(value))
        time = hours_minutes(change["tick"] * float(content["tau_s"]))
        changes[name] = f"{changes.get(name, '')} -> {became} at {time}"
        ticks.setdefault(name, []).append(f"{int(change['tick'])}")
    notes += [
        Note(
            f"the controller's {name} was changed in the run: {parameter_text(given.get(name))}"
            f"{became} (tick {', '.join(ticks[name])})"
        )
        for name, became in changes.items()
    ]
    if left_out > 0:
        notes.append(Note(f"{left_out} earlier changes of its parameters are left out"))
    exact_sensor = not (errors.get("roof_noise") or errors.get("roof_offset"))
    if not exact_sensor:
        of = "the results are of the true level" if "total_deviation_m3" in row else (
            "the results are computed from it"
        )
        named = labels(row)["sensor and pump errors"]
        notes.append(Note(f"the roof's level is what a sensor reads ({named}); {of}"))
    ending, short = ("", summary.DONE) if done else _ending(content)
    return ReportedRun(
        site=site, row=row, parameters=given, exact_sensor=exact_sensor, changes=changes,
        zone=None if start is None else start.tzinfo, ending=ending, short=short,
        own=not live,  # live sensors can report anything
        incidents=tuple(Incident(**incident) for incident in content.get("incidents") or []),
        notes=tuple(notes),
    )


def _row(content: Mapping[str, Any], *, live: bool, done: bool) -> Row:
    """Return a summary's row: what was requested, what was done to its weather, the results."""
    forecast = {"file": content.get("forecast")} if live else content.get("forecast") or {}
    row = {
        "controller": content["controller"],
        "weather": Path(content.get("weather") or "").name,
        "evapotranspiration": content.get("evapotranspiration_method"),
        "gaps": content.get("gaps"),
        "forecast": forecast.get("file") or forecast.get("model"),
        **{f"forecast_{option}": forecast.get(option) for option in OPTIONS},
        **summary_columns(content),
    }
    for name in (*(metric.name for metric in METRICS), "frost_hours"):
        value = row.pop(name, None)
        if done and value is not None:
            row[name] = float(value)
    row = {column: value for column, value in row.items() if value not in (None, "")}
    if done and not live and "steps" in content:
        row |= {
            "start": to_people(datetime.fromisoformat(content["start"])),
            "hours": content["steps"] * content["tau_s"] / 3600,
        }
    initial = content.get("initial")
    if not initial:
        return row
    volumes = {key: float(initial[key]) for key in ("cistern_m3", "roof_m3")}
    return {**row, **volumes, "initial": initial.get("name", "")}


def _ending(content: Mapping[str, Any]) -> tuple[str, str]:
    """Return how an unfinished run ended, by its summary: as a sentence, and in a few words."""
    sentence, short = _NOT_DONE[content["status"]]
    tick = content.get("last_tick")
    if tick is not None:
        time = hours_minutes_seconds(tick * content["tau_s"])
        sentence += f" at tick {tick} of {content['steps']} ({time})"
        short += f" at tick {tick}"
    if content.get("reason"):
        # The reason can include the last lines of a log.
        sentence += f": {' '.join(content['reason'].split())}"
    return sentence, short
