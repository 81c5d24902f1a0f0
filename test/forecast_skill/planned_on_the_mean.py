"""What the mean of five members is worth to a controller that takes a single forecast.

``python test/forecast_skill/planned_on_the_mean.py DIR``: each season of the grid beside this file
twice, with member 0 and with the mean of the members, which tells more (``--ensembles`` says how
much). ``lookahead`` has that from its five members, too, and is held against controllers with
one. DIR: as for config/study_seasons.yaml. 44 runs, seven minutes on one core.
"""

from __future__ import annotations

import sys
from datetime import datetime
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent.parent))

from greenroof_ros.forecast import resampling  # noqa: E402
from greenroof_ros.forecast.models import ForecastModel  # noqa: E402
from greenroof_ros.study.case_run import run_case  # noqa: E402
from greenroof_ros.study.grid import Case, read_grid  # noqa: E402

make_model = resampling.make_model


class Mean:
    """The mean of an ensemble's members, as a single forecast."""

    def __init__(self, ensemble: ForecastModel) -> None:
        """Take the ensemble."""
        self._ensemble = ensemble

    def known(self, hour: int, hours: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the forecast; see :class:`greenroof_ros.forecast.models.ForecastModel`."""
        rain, evapotranspiration = self._ensemble.known(hour, hours)
        return rain.mean(axis=0, keepdims=True), evapotranspiration

    def repeats_from(self, hour: int, hours: int) -> datetime | None:
        """Return from when on these hours are assumed."""
        return self._ensemble.repeats_from(hour, hours)


def deviation(case: Case, mean: bool) -> float:
    """Return the total deviation (m3) of a run with member 0, or with the mean."""
    resampling.make_model = (
        (lambda choice, weather, site, _: Mean(make_model(choice, weather, site, True)))
        if mean else make_model
    )
    return float(run_case(case, "inprocess", None).results["total_deviation_m3"])


def main() -> None:
    """Run the seasons and print a table."""
    found: dict[int, list[tuple[float, float]]] = {}
    print("| season | seed | one member (m3) | the mean (m3) | over one |\n|---|---|---|---|---|")
    for case in read_grid(HERE / "planned_on_the_mean.yaml", Path(sys.argv[1])):
        one, mean = deviation(case, False), deviation(case, True)
        found.setdefault(case.forecast.seed, []).append((one, mean))
        print(
            f"| {case.start[:4]} | {case.forecast.seed} | {one:.0f} | {mean:.0f} "
            f"| {mean / one:.3f} |", flush=True,
        )
    print()
    for seed, runs in found.items():
        one, mean = np.sum(runs, axis=0)
        print(f"seed {seed}: one member has {one / mean - 1:.1%} more")
    one, mean = np.sum(list(found.values()), axis=(0, 1))
    print(f"in all: {one / mean - 1:.1%}")


if __name__ == "__main__":
    main()
