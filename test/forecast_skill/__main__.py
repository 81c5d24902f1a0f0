"""How good the package's forecasts are: ``python test/forecast_skill WEATHER SKILL``.

WEATHER is a directory of hourly bulk files of Toronto City Centre (2015 to 2025), SKILL a file of
the services' figures (``test/data/skill.csv``). Each skill's forecasts of May to October are held
against the records: r, POD, FAR and bias of sums over 1, 6, 12 and 24 h, one, two, three and five
days ahead, beside the least and the greatest of the services. With ``--fit`` the climate and the
errors of config/forecasts/skill.yaml are fitted first, and printed.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent.parent)]

from figures import DAYS, NAMES, SUMS, Warm, days_ahead, services  # noqa: E402
from fitting import Sample, fit_climate, fit_errors  # noqa: E402

from greenroof_ros.common.files import shared_directory  # noqa: E402
from greenroof_ros.forecast.error_model import ErrorModel  # noqa: E402
from greenroof_ros.forecast.issue_times import hours_since_1970  # noqa: E402
from greenroof_ros.forecast.skill import REAL, SKILLS, read_skill  # noqa: E402
from greenroof_ros.model.site import read_site  # noqa: E402
from greenroof_ros.weather.reading import read_weather  # noqa: E402
from greenroof_ros.weather.records import HOUR  # noqa: E402

YEARS = range(2015, 2026)


def read_years(directory: Path):
    """Return the weather of the years; missing rain counts as none."""
    files = [
        file for file in sorted(directory.rglob("*.csv"))
        if file.stem[:4].isdecimal() and int(file.stem[:4]) in YEARS
    ]
    weather = read_weather(files, read_site(shared_directory() / "config" / "site.yaml"))
    rain = np.nan_to_num(weather.precipitation)
    return replace(weather, precipitation=rain, evapotranspiration=np.zeros(len(rain)))


def fitted(weather, warm: Warm, spread) -> None:
    """Fit climate and errors, and print them."""
    climate = fit_climate(weather.precipitation, warm.hours)
    print("climate:", {name: round(value, 4) for name, value in asdict(climate).items()})
    now = read_skill(REAL)
    sample = Sample(now.climate, weather.precipitation, hours_since_1970(weather.first), 3)
    low, high, mean = (
        np.array([
            [how(np.array(list(spread[day, hours].values()))[:, :3], axis=0) for hours in SUMS]
            for day in DAYS
        ])
        for how in (np.min, np.max, np.mean)
    )
    # The newest issue that is a day old is 24 to 29 h old.
    leads = [24 * day + 2.5 for day in DAYS]
    errors = fit_errors(sample, warm.figures, low, high, mean, leads, now.errors)
    print("errors:", {name: round(value, 4) for name, value in asdict(errors).items()})


def table(weather, warm: Warm, spread, name: str, seeds: int) -> None:
    """Print a skill's figures, the mean over seeds, beside the services'."""
    hours = len(weather.precipitation)
    found = np.mean([
        [
            warm.figures(forecast) for forecast in days_ahead(
                ErrorModel(weather, seed, read_skill(name)), weather.first, hours, DAYS
            ).values()
        ]
        for seed in range(1, seeds + 1)
    ], axis=0)
    print(f"\n{name}, mean of {seeds} seeds\n")
    print("| days ahead | sums over | " + " | ".join(NAMES) + " |")
    print("|---" * (2 + len(NAMES)) + "|")
    outside = 0
    for day, rows in zip(DAYS, found, strict=True):
        for length, row in zip(SUMS, rows, strict=True):
            of = np.array(list(spread[day, length].values()))
            cells = []
            for value, low, high in zip(row, of.min(axis=0), of.max(axis=0), strict=True):
                out = value < low - 0.005 or value > high + 0.005
                outside += out and len(cells) < 3
                text = f"**{value:.2f}**" if out else f"{value:.2f}"
                cells.append(f"{text} ({low:.2f} - {high:.2f})")
            print(f"| {day} | {length} h | " + " | ".join(cells) + " |")
    print(f"\nr, POD, FAR beyond the services': {outside} of {3 * len(DAYS) * len(SUMS)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("weather", type=Path)
    parser.add_argument("skill", type=Path)
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--skills", nargs="*", default=[REAL], choices=list(SKILLS))
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    weather = read_years(arguments.weather)
    print(f"{weather.first} to {weather.end - HOUR}")
    warm = Warm(weather.precipitation, weather.first)
    spread = services(arguments.skill)
    if arguments.fit:
        fitted(weather, warm, spread)
    for name in arguments.skills:
        table(weather, warm, spread, name, arguments.seeds)


if __name__ == "__main__":
    main()
