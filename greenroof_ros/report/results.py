"""What the figures and tables show: results, and how they fall into settings and windows."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.times import to_people
from greenroof_ros.forecast.choice import PERFECT
from greenroof_ros.recording.results_table import differing, shortest
from greenroof_ros.report.assessment import Assessment, Assumptions, assess
from greenroof_ros.report.entries import Note, RunEntry
from greenroof_ros.report.settings import PAPERS_CONTROLLERS, Settings, controller_name

MOST_POINTS = 500
"""of a drawn line; totals are of all samples"""


class Curve(NamedTuple):
    """A line as it is drawn: at most :data:`MOST_POINTS` points."""

    time: NDArray[np.float64]
    """s since the start"""
    value: NDArray[np.float64]

    def points(self) -> Iterator[tuple[float, float]]:
        """Yield time and value of each point."""
        return zip(self.time, self.value, strict=True)


@dataclass(frozen=True)
class Result:
    """A run, its results, and what of it is drawn.

    Attributes:
        entry: the run.
        notes: what a reader should know of it.
        start: time of the first sample.
        assessment: its results.
        curves: by the name of the trajectory's attribute.
        frost: from and to (s since the start) of each time of frost.
        bound_m3: the least total deviation that a controller with commands up to 1 could reach;
            None if unknown.
    """

    entry: RunEntry
    notes: tuple[Note, ...]
    start: datetime
    assessment: Assessment
    curves: dict[str, Curve]
    frost: tuple[tuple[float, float], ...]
    bound_m3: float | None = None

    @property
    def ratio_to_bound(self) -> float | None:
        """Total deviation over the least that was possible (1); None if that is unknown, or 0."""
        total = self.assessment.metrics["total_deviation_m3"]
        return total / self.bound_m3 if self.bound_m3 else None

    @property
    def window(self) -> Window:
        """What the run can be compared within."""
        entry = self.entry
        sky = Sky(
            site_name=entry.site_name, weather=entry.weather, start=self.start,
            hours=round(self.assessment.hours, 6),
        )
        return Window(sky, entry.method, entry.forecast, entry.sensor_pump_errors)


@dataclass(frozen=True)
class Sky:
    """Runs of one site under the same sky: they share a figure of the weather."""

    site_name: str
    weather: str
    start: datetime
    hours: float

    @property
    def facts(self) -> Facts:
        """What it is, as :func:`heading` takes it."""
        return {
            "site": self.site_name, "weather": self.weather, "start": to_people(self.start),
            "length": f"{shortest(round(self.hours, 5))} h",
        }


@dataclass(frozen=True)
class Window:
    """Runs of one site, weather and forecast: only controller and initial state differ in it.

    Attributes:
        sky: site, weather, start and length.
        method: of the evapotranspiration.
        forecast: empty where it was perfect.
        sensor_pump_errors: of level sensor and pumps; empty where there were none.
    """

    sky: Sky
    method: str
    forecast: str
    sensor_pump_errors: str

    @property
    def facts(self) -> Facts:
        """What it is, as :func:`heading` takes it."""
        return {
            **self.sky.facts, "evapotranspiration": self.method,
            "forecast": self.forecast or PERFECT,
            "sensor and pump errors": self.sensor_pump_errors or NO_ERRORS,
        }


Facts = dict[str, str]
"""What runs that are compared have in common, each under the header of its column."""

NO_ERRORS = "none"


def heading(facts: Facts, apart: Sequence[str]) -> str:
    """Name a set of runs: by what tells it apart from others, and what a reader asks for anyway.

    Args:
        facts: of it.
        apart: those that tell it apart, see
            :func:`greenroof_ros.recording.results_table.differing`.
    """
    usual = {"site": facts.get("site"), "forecast": PERFECT, "sensor and pump errors": NO_ERRORS}
    return ", ".join(
        f"{name} {text}" if name in ("evapotranspiration", "forecast") or text == NO_ERRORS
        else text
        for name, text in facts.items() if name in apart or text != usual.get(name)
    )


def thin(values: NDArray[np.float64], most: int = MOST_POINTS) -> NDArray[np.intp]:
    """Return which samples to draw: the first, the last, and each bucket's least and largest.

    Args:
        values: shape (n,).
        most: number of samples to keep, about; all are kept where there are no more.
    """
    count = len(values)
    if count <= most:
        return np.arange(count)
    edges = np.linspace(0, count, (most - 2) // 2 + 1).astype(np.intp)
    kept = {0, count - 1}
    for low, high in itertools.pairwise(edges):
        kept.add(int(low + np.argmin(values[low:high])))
        kept.add(int(low + np.argmax(values[low:high])))
    return np.array(sorted(kept), dtype=np.intp)


def result(entry: RunEntry, assumptions: Assumptions) -> Result:
    """Read a run, judge it, and keep of it what is drawn.

    Raises:
        ConfigurationError: its file is damaged, or foreign.
    """
    trajectory, notes = entry.load()
    assessment = assess(entry.site, trajectory, assumptions)
    curves = {}
    for name in ("command", "cistern", "roof", "precipitation", "evapotranspiration"):
        values = getattr(trajectory, name)
        if name not in ("cistern", "roof"):
            # The run ends in its last sample: what would hold from then on never did.
            values = np.append(values[:-1], values[-2])
        index = thin(values)
        curves[name] = Curve(trajectory.time[index], values[index])
    frozen = np.concatenate([[0], trajectory.frost[:-1] > 0, [0]]).astype(int)
    steps = np.diff(frozen)
    begins = trajectory.time[np.flatnonzero(steps > 0)]
    ends = trajectory.time[np.flatnonzero(steps < 0)]
    frost = tuple(zip(begins.tolist(), ends.tolist(), strict=True))
    return Result(
        entry=entry,
        notes=(*entry.notes, *map(Note, notes)),
        start=trajectory.start,
        assessment=assessment,
        curves=curves,
        frost=frost,
        bound_m3=entry.bound(trajectory),
    )


class Report:
    """All results, and how they fall into controllers, settings, windows and initial states.

    Attributes:
        results: every run that left something to show but the seeded ones.
        seeded: runs of which only what the study's table says is known, as they differ from others
            in the seed of their forecasts' errors alone.
        seasons: runs of which only that is known as well, as they are the same season of years.
        entries: of all of them.
        controllers: names, the paper's first.
        settings: of each controller.
        windows: of the results, in their order.
        apart: the facts that differ between them, which are columns and in titles.
        initials: names of the results' initial states, in their order.
    """

    def __init__(
        self, results: Sequence[Result], seeded: Sequence[RunEntry] = (),
        seasons: Sequence[RunEntry] = (),
    ) -> None:
        self.results = list(results)
        self.seeded = list(seeded)
        self.seasons = list(seasons)
        self.entries = [*(one.entry for one in results), *seeded, *seasons]
        found = list(dict.fromkeys(entry.controller for entry in self.entries))
        self.controllers = [name for name in PAPERS_CONTROLLERS if name in found]
        self.controllers += [name for name in found if name not in PAPERS_CONTROLLERS]
        self.settings = {
            name: Settings([entry for entry in self.entries if entry.controller == name])
            for name in self.controllers
        }
        self.windows = list(dict.fromkeys(one.window for one in results))
        self.apart = differing([window.facts for window in self.windows])
        self.initials = list(dict.fromkeys(one.entry.initial for one in results))

    def label(self, one: Result) -> str:
        """Return controller and setting of a run."""
        name = controller_name(one.entry.controller)
        return f"{name} {self.settings[one.entry.controller].full_label(one.entry)}"

    def title(self, text: str, window: Window) -> str:
        """Return a figure's title, with the window where there are others."""
        return f"{text}: {self.heading(window)}" if len(self.windows) > 1 else text

    def heading(self, of: Window | Sky) -> str:
        """Name a window, or what is common to those under one sky."""
        return heading(of.facts, self.apart)

    def of(self, window: Window, controller: str = "", initial: str = "") -> list[Result]:
        """Return the runs of a window, and if given of a controller and an initial state."""
        return [
            one for one in self.results
            if one.window == window
            and controller in ("", one.entry.controller)
            and initial in ("", one.entry.initial)
        ]


@dataclass(frozen=True)
class Best:
    """The run of a controller with the least total deviation from an initial state."""

    window: Window
    initial: str
    setting: str
    run: Result


def best_runs(report: Report) -> list[Best]:
    """Return the best run of each controller in each window from each initial state."""
    found = []
    for window, initial, controller in itertools.product(
        report.windows, report.initials, report.controllers
    ):
        runs = report.of(window, controller, initial)
        if runs:
            totals = [one.assessment.metrics["total_deviation_m3"] for one in runs]
            least = runs[totals.index(min(totals))]
            alike = len(runs) > 1 and min(totals) == max(totals)
            setting = report.settings[controller].full_label(least.entry)
            found.append(
                Best(
                    window=window, initial=initial, setting="all alike" if alike else setting,
                    run=least,
                )
            )
    return found
