"""What a run wrote about itself beside its bag: labels and notes, no numbers."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime, tzinfo
from pathlib import Path
from typing import Any

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import YamlMapping, read_text, read_yaml
from greenroof_ros.common.times import hours_minutes_seconds
from greenroof_ros.experiment import summary
from greenroof_ros.experiment.incidents import INCIDENTS, Incident, read_incidents
from greenroof_ros.forecast.choice import OPTIONS, PERFECT
from greenroof_ros.formats.records import name_files
from greenroof_ros.model.initial_state import INITIAL_STATES
from greenroof_ros.model.sensor_pump_errors import PARAMETERS
from greenroof_ros.recording.results_table import shortest
from greenroof_ros.report.entries import Change, Ending, Note, Parameters, parameter_text
from greenroof_ros.weather.filling import REFUSE

LABELLED = (*OPTIONS, "dressed")
"""What names forecasts beside their model or file, in this order."""

_PARAMETERS = "configuration/parameters.yaml"

# What a run did that is not done, as a sentence and in short, by the status of its summary.
_NOT_DONE = {
    "failed": ("failed", "failed"),
    "interrupted": ("was interrupted", "interrupted"),
    "running": ("has not ended, or bringup was killed", "not ended"),
}


@dataclass(frozen=True)
class About:
    """What a run wrote about itself; as it is here where it wrote nothing.

    Attributes:
        controller: its name.
        parameters: the controller's at the start; no entry where there is no bound.
        initial: name of the initial state, or its volumes.
        what_initial: what that name means; None where it is unknown.
        weather: name of the weather.
        method: of the evapotranspiration.
        gaps: what was done about gaps in the weather files.
        forecast: what the controller was given of the weather to come; empty if that was what came.
        sensor_pump_errors: of level sensor and pumps; empty if there were none.
        exact_sensor: whether the roof's level is the true one.
        zone: offset from UTC; None where it is unknown.
        own: whether this package wrote it.
        external_pump: whether its flow was that of a pump driver.
        changes: of parameters, in the run.
        ending: how the run ended; None if it is done, or nothing says that it is not.
        incidents: what was lost in the run while it went on.
        notes: what a reader should know of the run.
    """

    controller: str = "unknown"
    parameters: Parameters = field(default_factory=dict)
    initial: str = "as recorded"
    what_initial: object = None
    weather: str = "as recorded"
    method: str = "unknown"
    gaps: str = REFUSE
    forecast: str = ""
    sensor_pump_errors: str = ""
    exact_sensor: bool = True
    zone: tzinfo | None = None
    own: bool = False
    external_pump: bool = False
    changes: tuple[Change, ...] = ()
    ending: Ending | None = None
    incidents: tuple[Incident, ...] = ()
    notes: tuple[Note, ...] = ()


def read_about(run: Path) -> About:
    """Read a run's summary, or if there is none that is whole, the parameters of its nodes.

    Labels hang on these files, no numbers: one that is damaged or foreign leaves a note. Incidents
    have a file of their own, which is there before a summary has them; it counts where it is there.
    """
    notes: list[Note] = []
    incidents: tuple[Incident, ...] = ()
    try:
        incidents = tuple(read_incidents(run))
    except (OSError, ValueError) as error:
        reason = str(error).removeprefix(f"{run / INCIDENTS}").lstrip(":, ")
        notes.append(Note(f"{INCIDENTS} beside the bag is damaged, and not used: {reason}"))
    for name, read in ((summary.SUMMARY, _summary), (_PARAMETERS, _node_parameters)):
        if not (run / name).is_file():
            continue
        try:
            about = _understand(read(run / name))
        except Exception as error:  # a foreign file can be wrong in any way
            reason = "it lacks what a run writes about itself"
            if isinstance(error, ConfigurationError):
                reason = str(error).removeprefix(f"{run / name}").lstrip(":, ")
            notes.append(
                Note(f"{name} beside the bag is damaged or foreign, and not used: {reason}")
            )
            continue
        return replace(
            about, external_pump=_external_pump(run), notes=(*notes, *about.notes),
            incidents=incidents or about.incidents,
        )
    return About(notes=tuple(notes), incidents=incidents)


def _summary(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(read_text(file))
    except ValueError as error:
        raise ConfigurationError(f"is not valid JSON: {error}", file=file) from error
    if not isinstance(content, dict):
        raise ConfigurationError("must hold one object", file=file)
    return content


def _external_pump(run: Path) -> bool:
    """Whether the parameters of a run's nodes say that a pump driver was to give the flow."""
    try:
        return bool(_nodes(run / _PARAMETERS)["plant"]["pump"] == "external")
    except Exception:  # no such file, or a foreign one, which can be wrong in any way
        return False


def _nodes(file: Path) -> dict[str, YamlMapping]:
    """Return the parameters of each of a run's nodes, by its name."""
    nodes: dict[str, YamlMapping] = {}
    for key, section in read_yaml(file).items():
        values = section.get("ros__parameters") if isinstance(section, YamlMapping) else None
        if not isinstance(values, YamlMapping):
            raise ConfigurationError("must hold 'ros__parameters:'", file=file, key=key)
        nodes[key.removeprefix("/**/")] = values
    return nodes


def _node_parameters(file: Path) -> dict[str, Any]:
    """Return the parameters of a run's nodes in the form of a summary."""
    nodes = _nodes(file)
    empty = YamlMapping()
    plant, weather = nodes.get("plant", empty), nodes.get("weather", empty)
    controller = nodes.get("recorder", empty).get("controller")
    about: dict[str, Any] = {
        "controller": controller,
        "parameters": {
            key: value
            for key, value in nodes.get(str(controller), empty).items() if key != "site_file"
        },
        "weather": name_files([Path(file) for file in weather.get("weather_files") or []]),
        "evapotranspiration_method": weather.get("evapotranspiration"),
        "gaps": weather.get("gaps"),
        "forecast": {
            "model": weather.get("forecast"),
            **{option: weather.get(f"forecast_{option}") for option in OPTIONS},
            "dressed": weather.get("dressed"),
        },
        "sensor_pump_errors": {name: plant.get(name) for name in PARAMETERS},
    }
    volumes = plant.get("initial_cistern_volume"), plant.get("initial_roof_volume")
    if None not in volumes:
        about["initial"] = dict(zip(("cistern_m3", "roof_m3"), volumes, strict=True))
    if "start" in plant:
        about["start"] = plant["start"]
    return about


def _understand(content: dict[str, Any]) -> About:
    """Return what a summary says.

    Raises:
        Exception: of many kinds, where it is no summary.
    """
    if not isinstance(content["controller"], str):
        raise TypeError
    initial, forecast = content.get("initial"), content.get("forecast") or {}
    live = "drive_at" in content
    if live:
        forecast = {"file": forecast}
    notes = [Note(text) for text in content.get("weather_notes") or []]
    notes += [
        Note(f"{quantity} was missing and filled in", listed=", ".join(hours))
        for quantity, hours in (content.get("filled") or {}).items()
    ]
    notes += [suspicion(text) for text in content.get("suspicious") or []]
    notes += run_notes(
        float((content.get("solver") or {}).get("fallbacks") or 0),
        content.get("forecast_repeats_last_record_from"),
        float(content.get("limited_steps") or 0),
    )
    given = parameters(content.get("parameters") or {})
    changes = [
        Change(
            parameter=str(change["parameter"]),
            value=None if change["value"] is None else float(change["value"]),
            tick=int(change["tick"]),
            time=change["tick"] * float(content["tau_s"]),
        )
        for change in content.get("parameter_changes") or []
    ]
    for name in dict.fromkeys(change.parameter for change in changes):
        found = [change for change in changes if change.parameter == name]
        ticks = ", ".join(f"{change.tick}" for change in found)
        notes.append(Note(
            f"the controller's {name} was changed in the run: {parameter_text(given.get(name))}"
            f"{''.join(map(str, found))} (tick {ticks})"
        ))
    lost = content.get("incidents") or []
    site = content.get("sensor_pump_errors") or {}
    sensor_pump_errors = sensor_pump_errors_label(site)
    exact_sensor = not (site.get("roof_noise") or site.get("roof_offset"))
    if not exact_sensor:
        notes.append(Note(
            f"the roof's level is what a sensor reads ({sensor_pump_errors}); the summary's "
            "deviation is of the true one"
        ))
    return About(
        controller=content["controller"],
        parameters=given,
        initial=(
            initial_label(initial.get("name", ""), initial["cistern_m3"], initial["roof_m3"])
            if initial else About.initial
        ),
        what_initial=(
            what_initial(initial.get("name", ""), initial["cistern_m3"], initial["roof_m3"])
            if initial else None
        ),
        weather=Path(content.get("weather") or About.weather).name,
        method=str(content.get("evapotranspiration_method") or About.method),
        gaps=str(content.get("gaps") or About.gaps),
        forecast=forecast_label(forecast.get("file") or forecast.get("model"), forecast),
        sensor_pump_errors=sensor_pump_errors,
        exact_sensor=exact_sensor,
        zone=datetime.fromisoformat(content["start"]).tzinfo if "start" in content else None,
        own=not live,  # what sensors said may be anything
        changes=tuple(changes),
        ending=_ending(content) if content.get("status", summary.DONE) != summary.DONE else None,
        incidents=tuple(Incident(**incident) for incident in lost),
        notes=tuple(notes),
    )


def _ending(content: Mapping[str, Any]) -> Ending:
    """Return how a run ended that is not done, by its summary."""
    sentence, short = _NOT_DONE[content["status"]]
    tick = content.get("last_tick")
    if tick is not None:
        time = hours_minutes_seconds(tick * content["tau_s"])
        sentence += f" at tick {tick} of {content['steps']} ({time})"
        short += f" at tick {tick}"
    if content.get("reason"):
        # The last lines of a log may be among it.
        sentence += f": {' '.join(content['reason'].split())}"
    return Ending(sentence, short)


def suspicion(rain: str) -> Note:
    """Say that an hour of rain, as named, is hard to believe."""
    return Note(f"suspicious, and taken as it is: {rain}")


def run_notes(fallbacks: float, repeats_from: str | None, limited: float) -> list[Note]:
    """Say what happened in a run that its trajectory does not show.

    Args:
        fallbacks: ticks in which the controller's solver found no answer.
        repeats_from: time from which on the forecast knows nothing, and what it says is assumed.
        limited: ticks in which a tank held less than was asked of it.
    """
    notes: list[Note] = []
    if fallbacks:
        notes.append(Note("the controller's solver found no answer in {count} ticks", fallbacks))
    if repeats_from:
        notes.append(Note(f"a forecast ends at {repeats_from}, and what follows is assumed"))
    if limited:
        notes.append(
            Note("a tank ran empty in {count} ticks, and what left it was limited", limited)
        )
    return notes


def parameters(cells: Mapping[str, object]) -> Parameters:
    """Return the parameters that are there and mean something: no blank, no infinite bound."""
    found: Parameters = {}
    for key, cell in cells.items():
        if cell is None or cell == "":
            continue
        try:
            value = float(str(cell))
        except ValueError:
            found[key] = str(cell)
            continue
        if math.isfinite(value):
            found[key] = value
    return found


def forecast_label(name: str | None, options: Mapping[str, object]) -> str:
    """Return a name for forecasts with those of their options that are there; none if perfect."""
    if not name or name == PERFECT:
        return ""
    given = {option: options.get(option) for option in LABELLED}
    texts = [
        f"{option} {Path(str(value)).name if option == 'dressed' else value}"
        for option, value in given.items() if value not in (None, "")
    ]
    return " ".join([Path(name).name, *texts])


def sensor_pump_errors_label(values: Mapping[str, object]) -> str:
    """Return a name for those sensor_pump_errors of level sensor and pumps that are there."""
    given = {name: float(str(values.get(name) or 0)) for name in PARAMETERS}
    seed = given.pop("noise_seed")
    texts = [
        f"{name.replace('_', ' ')} {shortest(value)} {'m' if name.startswith('roof') else 's'}"
        for name, value in given.items() if value
    ]
    if given["roof_noise"]:
        texts.append(f"seed {shortest(seed)}")
    return ", ".join(texts)


def initial_label(name: str, cistern: float, roof: float) -> str:
    """Return a name for an initial state, its volumes (m3) where it has none."""
    return f"{cistern:.4g} / {roof:.4g} m3" if name in ("", "custom") else name


def what_initial(name: str, cistern: float, roof: float) -> object:
    """Return what an initial state's name means: Table II's states differ with the site."""
    return name if name in INITIAL_STATES else (cistern, roof)
