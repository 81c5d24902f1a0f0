"""Simulations of many runs under on/off control, which yield all results of :mod:`.closed_loop`.

:mod:`.batch` steps the plants, and :class:`.metrics.BlockMetrics` adds up the results, run by run.
The results equal those of single runs apart from the rounding in each tick; see :mod:`.plants`.
Only the time with a command above 1 can differ by whole ticks: if the roof is at its target,
nothing flows, but rounding can put the roof above or below the target.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.controllers.protocol import ControllerClass
from greenroof_ros.experiment.batch import Batch, BatchWeather, Part, simulate_parts
from greenroof_ros.model.plants import Moved
from greenroof_ros.physics.plant import Flows, has_short_ticks
from greenroof_ros.physics.sensor_and_pump import SensorAndPump
from greenroof_ros.results.metrics import BLOCK, BlockMetrics, end_state
from greenroof_ros.simulation import summary
from greenroof_ros.simulation.plan import find_pumping_ticks
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.site import Site

Values = NDArray[np.float64]

# N of the longest run, and ticks of weather that are kept at a time, 24 bytes each.
_MAX_STEPS, _TICKS = 2_000_000, 4_000_000
_STATE = ("cistern", "roof", "layer")


def is_covered(
    site: Site, controller: ControllerClass, sensor_and_pump: SensorAndPump, steps: int
) -> bool:
    """Return whether a run can be simulated together with other runs.

    Runs with short ticks cannot be simulated together: Euler's method lets an outlet take more than
    the water above it in one tick and less in the next tick, which makes rounding errors grow.

    Args:
        site: site of the run.
        controller: class of the controller.
        sensor_and_pump: errors of the sensor and the pumps.
        steps: number of steps, N.
    """
    exact = sensor_and_pump.exact_sensor and sensor_and_pump.instant_pump
    return (
        controller is OnOff and exact and not has_short_ticks(site) and steps <= _MAX_STEPS
    )


def simulate_runs(
    runs: Sequence[Run], progress: Callable[[float], None] | None = None
) -> list[dict[str, Any]]:
    """Return the content of each run's ``summary.json``.

    Args:
        runs: runs with the same tau and number of steps, all of which :func:`is_covered` accepts.
        progress: callback that regularly receives the completed share of the work (1).
    """
    summaries: dict[int, dict[str, Any]] = {}
    for rows in _split(runs):
        chosen, began = [runs[row] for row in rows], time.monotonic()

        def begin(part: Part, chosen: Sequence[Run] = chosen) -> _Records:
            return _Records(part, [chosen[row] for row in part.rows])

        def report(share: float, count: int = len(rows), before: int = len(summaries)) -> None:
            if progress is not None:
                progress((before + share * count) / len(runs))

        for part, records in simulate_parts(_make_batch(chosen), begin, report):
            wall_s = (time.monotonic() - began) / len(rows)  # shared by all
            for row, made in zip(part.rows, records.summaries(wall_s), strict=True):
                summaries[rows[row]] = made
    return [summaries[row] for row in range(len(runs))]


def _weather_key(run: Run) -> tuple[Any, ...]:
    """Return a key that is identical for runs with the same weather and the same forecasts."""
    return id(run.weather), run.start, run.site.M, run.forecast_choice


def _split(runs: Sequence[Run]) -> Iterator[list[int]]:
    """Yield the indices of runs whose weather is held in memory at the same time."""
    if not runs:
        return
    places: dict[tuple[Any, ...], list[int]] = {}
    for place, run in enumerate(runs):
        places.setdefault(_weather_key(run), []).append(place)
    alike, most = list(places.values()), max(1, _TICKS // runs[0].steps)
    for first in range(0, len(alike), most):
        yield [place for same in alike[first : first + most] for place in same]


def _make_batch(runs: Sequence[Run]) -> Batch:
    firsts: dict[tuple[Any, ...], Run] = {}
    for run in runs:
        firsts.setdefault(_weather_key(run), run)
    number = {key: place for place, key in enumerate(firsts)}
    return Batch(
        sites=[run.site for run in runs],
        weather=[BatchWeather.of_run(run) for run in firsts.values()],
        weather_of=np.array([number[_weather_key(run)] for run in runs], dtype=np.intp),
        parameters=[run.parameters for run in runs],
        x1=np.array([run.x1 for run in runs]), x2=np.array([run.x2 for run in runs]),
    )


class _Records:
    """Records of the ticks of runs that are stepped together, until the records are added up."""

    def __init__(self, part: Part, runs: Sequence[Run]) -> None:
        """Record the initial state.

        Args:
            part: part of a batch.
            runs: runs of the part's rows.
        """
        self._plants, self._runs = part.plants, runs
        self._metrics = [BlockMetrics(run.site, run.time_ns(0) / 1e9) for run in runs]
        # State before each tick and after the last one, and water that moves in each tick (m3).
        self._states = np.empty((BLOCK + 1, len(_STATE), len(runs)))
        self._moved = np.empty((BLOCK, len(Moved._fields), len(runs)))
        self._first = self._count = 0
        self._write_state()

    def add(self, tick: int) -> None:
        """Add the water that moved in a tick, and the state at its end."""
        for row, values in zip(self._moved[self._count], self._plants.moved, strict=True):
            row[:] = values
        self._count += 1
        self._write_state()
        if self._count == BLOCK:
            self._add_up()

    def _write_state(self) -> None:
        row, plants = self._states[self._count], self._plants
        row[0], row[1], row[2] = plants.x1, plants.x2, plants.layer

    def _add_up(self) -> None:
        """Add up the ticks so far, run by run."""
        count, first = self._count, self._first
        for row, (run, metrics) in enumerate(zip(self._runs, self._metrics, strict=True)):
            cistern, roof, layer = self._states[:count, :, row].T
            metrics.add(np.stack((
                cistern, roof, layer, _find_commands(run, first, cistern, roof),
                run.series.precipitation[first : first + count],
                run.series.evapotranspiration[first : first + count],
                *self._flows(run, row),
            )))
        self._states[0] = self._states[count]
        self._first, self._count = first + count, 0

    def _flows(self, run: Run, row: int) -> Iterator[Values]:
        """Yield the flows of a run (m3/s), in the order of :class:`.plant.Flows`."""
        moved = Moved(*self._moved[: self._count, :, row].T)
        for name in Flows._fields:
            values = getattr(moved, name)
            yield values if name == "limited" else values / run.site.tau

    def summaries(self, wall_s: float) -> Iterator[dict[str, Any]]:
        """Yield the content of each run's ``summary.json``, after the last tick.

        Args:
            wall_s: wall time of a run (s).
        """
        if self._count:
            self._add_up()
        for row, (run, metrics) in enumerate(zip(self._runs, self._metrics, strict=True)):
            end = end_state(*self._states[0, :, row])
            yield summary.make_summary(
                run, metrics.results(end), metrics.weekly_deviations(end), metrics.events(end),
                wall_s=wall_s, solver=None,
            )


def _find_commands(run: Run, first: int, cistern: Values, roof: Values) -> Values:
    """Return the commands of on/off control.

    Args:
        run: the run.
        first: first tick.
        cistern: volumes in the cistern from the first tick on (m3), shape (ticks,).
        roof: volumes on the roof from the first tick on (m3), shape (ticks,).
    """
    site, parameters = run.site, run.parameters
    runs = find_pumping_ticks(run, first, first + len(roof))
    runs &= roof / site.a2 < parameters["level"] * site.z_veg
    runs &= cistern / site.a1 >= site.suction_level
    return np.where(runs, parameters["fraction"], 0.0)
