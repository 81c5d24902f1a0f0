"""The runs of a report: what is known of each before its trajectory is read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from greenroof_ros.common.times import hours_minutes
from greenroof_ros.experiment import summary
from greenroof_ros.experiment.incidents import Incident, with_incidents
from greenroof_ros.model.site import Site
from greenroof_ros.recording.bag_reader import Recorded
from greenroof_ros.recording.results_table import shortest
from greenroof_ros.recording.trajectory import Trajectory

Parameters = dict[str, "float | str"]


@dataclass(frozen=True)
class Note:
    """What a reader should know of a run.

    Attributes:
        text: of the note, with ``{count}`` where it counts something.
        count: how many; None where nothing is counted.
        listed: what it is about, one by one; the page folds it away.
    """

    text: str
    count: float | None = None
    listed: str = ""

    def __str__(self) -> str:
        """As it is of one run."""
        return self._with(f"{self.count:g}" if self.count is not None else "")

    def of_many(self) -> str:
        """As it is of many runs, each with a count of its own."""
        return self._with("some")

    def _with(self, count: str) -> str:
        return self.text.replace("{count}", count)


@dataclass(frozen=True)
class Change:
    """A parameter that was set while the run was under way.

    Attributes:
        parameter: its name.
        value: from then on; None where there is no bound.
        tick: the first with this value.
        time: of that tick since the start (s).
    """

    parameter: str
    value: float | None
    tick: int
    time: float

    def __str__(self) -> str:
        """As it stands behind the value before."""
        return f" -> {parameter_text(self.value)} at {hours_minutes(self.time)}"


@dataclass(frozen=True)
class Ending:
    """How a run ended, or not yet, that was not done.

    Attributes:
        sentence: about the run, without its name and full stop.
        short: the same in a few words.
    """

    sentence: str
    short: str


def parameter_text(value: float | str | None) -> str:
    """Return a parameter's value as people write it: 0.00001, not 1e-05."""
    if not isinstance(value, float):
        return value or "none"
    plain = 1e-7 < abs(value) < 1e7
    return np.format_float_positional(value, trim="-") if plain else shortest(value)


def counted(number: int, what: str) -> str:
    """Return how many there are of something: ``1 run``, ``2 runs``."""
    return f"{number} {what}{'s' if number != 1 else ''}"


@dataclass(frozen=True)
class Seeded:
    """What the table of a study says of a run whose forecasts had random errors.

    Attributes:
        model: the forecasts, without the skill and the seed of their errors.
        skill: of the forecasts, a name or a file.
        seed: of the errors.
        start: of the run, as headings name it.
        hours: its length (h).
        total_deviation_m3: its result.
        bound_m3: the least that any controller could reach; None if unknown.
    """

    model: str
    skill: str
    seed: str
    start: str
    hours: float
    total_deviation_m3: float
    bound_m3: float | None


@dataclass(frozen=True)
class Season:
    """What the table of a study says of a run of a week or more.

    Attributes:
        year: in which it begins.
        begins: month, day and time of that.
        hours: its length (h).
        metrics: those of :data:`greenroof_ros.model.metrics.METRICS` that the table has.
        weeks: total deviation of each whole week (m3).
        forecast: what the controller was given, without the seed of its errors.
        seed: of those errors; empty where there is none.
        bound_m3: the least total deviation that any controller could reach; None if unknown.
    """

    year: int
    begins: str
    hours: float
    metrics: Mapping[str, float]
    weeks: tuple[float, ...]
    forecast: str
    seed: str
    bound_m3: float | None


def known_bound(bound: float | None) -> Callable[[Trajectory], float | None]:
    """Return a bound (m3) whatever the trajectory: a study's own, or None where it is unknown."""
    return lambda _trajectory: bound


_UNKNOWN_BOUND = known_bound(None)


@dataclass(frozen=True)
class RunEntry:
    """A run, and how to read what happened in it.

    Attributes:
        name: of the run, unique in the report.
        site_name: where its site comes from.
        site: Table I.
        weather: name of the weather.
        method: of the evapotranspiration.
        controller: its name, ``unknown`` where it was not written down.
        parameters: the controller's at the start; no entry where there is no bound.
        initial: name of the initial state, or its volumes.
        notes: what a reader should know of it.
        load: reads the trajectory, and returns it with further notes.
        forecast: what the controller was given of the weather to come; empty where that was what
            came, or was not written down.
        bound: the least total deviation (m3) that a controller with commands up to 1 could reach,
            given the trajectory; None where it is unknown.
        sensor_pump_errors: of level sensor and pumps; empty where there were none, or they were
            not written down.
        seeded: what a study's table says of it; None unless its forecasts had random errors.
        season: what a study's table says of it; None unless it took a week.
        changes: of parameters, in the run.
        ending: how it ended; None if it is done, or nothing says that it is not.
        incidents: what was lost in it while it went on, the newest where there were very many.
        source: the study or run directory that it is from, by a name that no other one has.
        meant: what stands behind the names ``site_name``, ``weather``, ``forecast`` and
            ``initial``: where two sources use a name for different things, they are told apart.
    """

    name: str
    site_name: str
    site: Site
    weather: str
    method: str
    controller: str
    parameters: Parameters
    initial: str
    notes: tuple[Note, ...]
    load: Callable[[], Recorded]
    forecast: str = ""
    bound: Callable[[Trajectory], float | None] = _UNKNOWN_BOUND
    sensor_pump_errors: str = ""
    seeded: Seeded | None = None
    season: Season | None = None
    source: str = ""
    meant: Mapping[str, object] = field(default_factory=dict)
    changes: tuple[Change, ...] = ()
    ending: Ending | None = None
    incidents: tuple[Incident, ...] = ()

    @property
    def incident_count(self) -> int:
        """How many incidents there were: they are numbered from 1 on."""
        return max((incident.number for incident in self.incidents), default=0)

    @property
    def ended(self) -> str:
        """How it ended, in a few words, with how many incidents there were."""
        short = summary.DONE if self.ending is None else self.ending.short
        return with_incidents(short, self.incident_count)


def tell_apart(entries: Sequence[RunEntry]) -> list[RunEntry]:
    """Give different things of one name different names: the source is added to each.

    Equal ones keep an equal name, that of their first source, so that their runs are compared.
    """
    told = list(entries)
    for key in ("site_name", "weather", "forecast", "initial"):
        sources: dict[str, dict[object, str]] = {}
        for entry in told:
            of = sources.setdefault(getattr(entry, key), {})
            of.setdefault(entry.meant.get(key), entry.source)
        for place, entry in enumerate(told):
            name = getattr(entry, key)
            if len(sources[name]) > 1:
                own: dict[str, Any] = {key: f"{name} ({sources[name][entry.meant.get(key)]})"}
                told[place] = replace(entry, **own)
    return told


@dataclass(frozen=True)
class FailedRun:
    """A run that left nothing to show: it failed or was not begun, and why."""

    name: str
    what: str
    error: str


@dataclass
class Sources:
    """All that a report is made from.

    Attributes:
        runs: those that left something to show.
        failed: the others.
        configuration: name and text of each further file that decided the numbers.
    """

    runs: list[RunEntry] = field(default_factory=list)
    failed: list[FailedRun] = field(default_factory=list)
    configuration: dict[str, str] = field(default_factory=dict)
