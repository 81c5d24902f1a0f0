"""How good the package's forecasts are: ``python tools/forecast_skill``.

Each skill's forecasts of Toronto's rain, May to October 2015 to 2025, are compared with the
records: r, POD, FAR and bias of sums over 1, 6, 12 and 24 h, one, two, three and five days ahead,
with the range of the services in brackets. With ``--fit`` the climate and the errors of
config/forecasts/skill.yaml are fitted first, and printed. With ``--ensembles`` the tables show how
similar an ensemble's members are, and how much their mean gains, compared with three services, for
sums over 12, 24, 72 and 120 h. For the two longest sums only the similarity of the services is
known, which needs no gauge; their other figures are nan.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import paths  # noqa: F401
from forecast_skill.agreement import of_members, of_services
from forecast_skill.figures import (
    DAYS,
    NAMES,
    SUMS,
    TIP,
    figures,
    seasons,
    seasons_ahead,
    services,
)
from markdown_tables import head, row

from greenroof_ros.forecast.skill import REAL, SKILLS, read_skill
from greenroof_ros.verification.fitting import Sample, fit_climate, fit_errors
from greenroof_ros.verification.pairs import Sum

# Sums for which ensembles are compared (h): from half a day to what a roof has room for.
ENSEMBLE_SUMS = (12, 24, 72, 120)


def fit(rain: dict[int, np.ndarray], spread: dict[tuple[int, int], np.ndarray]) -> None:
    """Fit climate and errors, and print them."""
    climate = fit_climate(list(rain.values()), TIP)
    # Of issues every 6 h, the newest that is at least a day old is 24 to 29 h old.
    of_leads = {
        24 * day + 2.5: np.stack([spread[day, hours][:, :3] for hours in SUMS], axis=1)
        for day in DAYS
    }
    sample = Sample(climate, list(rain.values()), [Sum(*sums) for sums in SUMS.items()])
    errors = fit_errors(sample, of_leads, read_skill(REAL).errors, lambda _: None)
    for name, fitted in (("climate", climate), ("errors", errors)):
        print(f"{name}:", {key: round(value, 4) for key, value in asdict(fitted).items()})


def forecasts(
    rain: dict[int, np.ndarray], name: str, seeds: int, members: int
) -> list[dict[int, np.ndarray]]:
    """Return a skill's forecasts of all hours (mm) by days ahead, for each seed."""
    skill = read_skill(name)
    return [seasons_ahead(rain, skill, seed, DAYS, members) for seed in range(1, seeds + 1)]


def table(
    rain: dict[int, np.ndarray], spread: dict[tuple[int, int], np.ndarray], name: str, seeds: int
) -> None:
    """Print a skill's figures, means over the seeds, with the services' range."""
    observed = np.concatenate(list(rain.values()))
    of_seeds = forecasts(rain, name, seeds, 1)
    print(f"\n{name}, mean of {seeds} seeds\n\n{head(['days ahead', 'sums over', *NAMES])}")
    near = 0
    for day in DAYS:
        of_day = np.mean([figures(ahead[day][0], observed) for ahead in of_seeds], axis=0)
        for hours, values in zip(SUMS, of_day, strict=True):
            cells = [f"{day}", f"{hours} h"]
            low, high = spread[day, hours].min(axis=0), spread[day, hours].max(axis=0)
            beyond = np.maximum(low - values, values - high)
            near += (beyond[:3] <= 0.05).sum()
            for value, least, most, far in zip(values, low, high, beyond, strict=True):
                text = f"**{value:.2f}**" if far > 0 else f"{value:.2f}"
                cells.append(f"{text} ({least:.2f} - {most:.2f})")
            print(row(cells))
    print(
        f"\n{near} of {3 * len(DAYS) * len(SUMS)} values of r, POD and FAR are within 0.05 of the "
        "services' spread", flush=True,
    )


def ensembles(rain: dict[int, np.ndarray], name: str, seeds: int) -> None:
    """Print the similarity of services and of a skill's members, and the gain of their mean.

    Cells are services / as many members, r and ratios of r; for members the mean over the seeds.
    """
    observed = np.concatenate(list(rain.values()))
    issued = forecasts(rain, name, seeds, 5)
    print(f"\n{name}, ensembles, mean of {seeds} seeds\n")
    print(head([
        "days ahead", "sums over", "each with observed", "two with each other",
        "the mean with observed", "gain of the mean",
    ]))
    for day in DAYS:
        for hours in ENSEMBLE_SUMS:
            theirs = of_services(day, hours)
            ours = [of_members(ahead[day], observed, hours, len(theirs.alone)) for ahead in issued]
            print(row([f"{day}", f"{hours} h", *(
                f"{np.mean(getattr(theirs, key)):.2f} / "
                f"{np.mean([getattr(seed, key) for seed in ours]):.2f}"
                for key in ("alone", "pairs", "mean", "gain")
            )]), flush=True)


def main() -> None:
    """Fit if asked to, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--ensembles", action="store_true")
    parser.add_argument("--skills", nargs="*", default=[REAL], choices=list(SKILLS))
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    rain, spread = seasons(), services()
    if arguments.fit:
        fit(rain, spread)
    for name in arguments.skills:
        if arguments.ensembles:
            ensembles(rain, name, arguments.seeds)
        else:
            table(rain, spread, name, arguments.seeds)


if __name__ == "__main__":
    main()
