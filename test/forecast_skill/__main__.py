"""How good the package's forecasts are: ``python test/forecast_skill``.

Each skill's forecasts of Toronto's rain, May to October 2015 to 2025, are held against the records:
r, POD, FAR and bias of sums over 1, 6, 12 and 24 h, one, two, three and five days ahead, beside the
least and the greatest of the services'. With ``--fit`` the climate and the errors of
config/forecasts/skill.yaml are fitted first, and printed. With ``--ensembles`` the tables are of
how alike an ensemble's members are, and what their mean gains, beside those of three services, of
sums over 12, 24, 72 and 120 h. Of the two longest how alike services are needs no gauge; nan is
what does.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent.parent)]

from forecast_skill.agreement import of_members, of_services  # noqa: E402
from forecast_skill.figures import (  # noqa: E402
    DAYS,
    NAMES,
    SUMS,
    TIP,
    days_ahead,
    figures,
    seasons,
    services,
)

from greenroof_ros.forecast.skill import REAL, SKILLS, read_skill  # noqa: E402
from greenroof_ros.verification.fitting import Sample, fit_climate, fit_errors  # noqa: E402
from greenroof_ros.verification.pairs import Sum  # noqa: E402

# Hours of the sums of which ensembles are compared: half a day, up to what a roof has room for.
ENSEMBLE_SUMS = (12, 24, 72, 120)


def fit(rain: dict[int, np.ndarray], spread: dict[tuple[int, int], np.ndarray]) -> None:
    """Fit climate and errors, and print them."""
    climate = fit_climate(list(rain.values()), TIP)
    print("climate:", {name: round(value, 4) for name, value in asdict(climate).items()})
    # The newest issue that is a day old is 24 to 29 h old.
    of_leads = {
        24 * day + 2.5: np.stack([spread[day, hours][:, :3] for hours in SUMS], axis=1)
        for day in DAYS
    }
    sample = Sample(climate, list(rain.values()), [Sum(*one) for one in SUMS.items()])
    errors = fit_errors(sample, of_leads, read_skill(REAL).errors, lambda _: None)
    print("errors:", {name: round(value, 4) for name, value in asdict(errors).items()}, flush=True)


def table(
    rain: dict[int, np.ndarray], spread: dict[tuple[int, int], np.ndarray], name: str, seeds: int
) -> None:
    """Print a skill's figures, the mean over seeds, beside the services'."""
    skill, observed = read_skill(name), np.concatenate(list(rain.values()))
    found = []
    for seed in range(1, seeds + 1):
        ahead = [days_ahead(year, season, skill, seed, DAYS) for year, season in rain.items()]
        found.append([
            figures(np.concatenate([season[day][0] for season in ahead]), observed)
            for day in DAYS
        ])
    print(f"\n{name}, mean of {seeds} seeds\n")
    print("| days ahead | sums over | " + " | ".join(NAMES) + " |")
    print("|---" * (2 + len(NAMES)) + "|")
    inside = dict.fromkeys((0.0, 0.005, 0.05), 0)
    for day, of_day in zip(DAYS, np.mean(found, axis=0), strict=True):
        for hours, row in zip(SUMS, of_day, strict=True):
            cells = []
            low, high = spread[day, hours].min(axis=0), spread[day, hours].max(axis=0)
            for value, least, most in zip(row, low, high, strict=True):
                beyond = max(least - value, value - most)
                if len(cells) < NAMES.index("bias"):
                    for margin in inside:
                        inside[margin] += bool(beyond <= margin)
                text = f"**{value:.2f}**" if beyond > 0 else f"{value:.2f}"
                cells.append(f"{text} ({least:.2f} - {most:.2f})")
            print(f"| {day} | {hours} h | " + " | ".join(cells) + " |")
    print(f"\nr, POD, FAR within the services' spread, of {3 * len(DAYS) * len(SUMS)}:")
    for margin, number in inside.items():
        print(f"{number}, if {margin:g} beyond it counts as within", flush=True)


def ensembles(rain: dict[int, np.ndarray], name: str, seeds: int) -> None:
    """Print how alike services are, and members of a skill's ensembles, and what their mean gains.

    Cells are services / members, r and ratios of r; of members the mean over seeds. There are as
    many members as services, or five; five services are taken to be as alike as these.
    """
    skill, observed = read_skill(name), np.concatenate(list(rain.values()))
    issued = []
    for seed in range(1, seeds + 1):
        ahead = [days_ahead(year, season, skill, seed, DAYS, 5) for year, season in rain.items()]
        issued.append({
            day: np.concatenate([season[day] for season in ahead], axis=1) for day in DAYS
        })
    print(f"\n{name}, ensembles, mean of {seeds} seeds\n")
    heads = [
        "days ahead", "sums over", "each with what fell", "two with each other",
        "the mean with what fell", "gain of the mean", "gain of five", "mean of five members",
    ]
    print("| " + " | ".join(heads) + " |")
    print("|---" * len(heads) + "|")
    for day in DAYS:
        for hours in ENSEMBLE_SUMS:
            services = of_services(day, hours)
            few, five = (
                [of_members(each[day], observed, hours, count) for each in issued]
                for count in (len(services.alone), 5)
            )
            cells = [
                f"{day}", f"{hours} h",
                f"{_listed(services.alone)} / {np.mean([each.alone for each in few]):.2f}",
                f"{_listed(services.pairs)} / {np.mean([each.pairs for each in few]):.2f}",
                f"{services.mean:.2f} / {np.mean([each.mean for each in few]):.2f}",
                f"{services.gain:.2f} / {np.mean([each.gain for each in few]):.2f}",
                f"{services.gain_of(5):.2f} / {np.mean([each.gain for each in five]):.2f}",
                f"{np.mean([each.mean for each in five]):.2f}",
            ]
            print("| " + " | ".join(cells) + " |", flush=True)


def _listed(values: np.ndarray) -> str:
    return ", ".join(f"{value:.2f}" for value in values)


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
