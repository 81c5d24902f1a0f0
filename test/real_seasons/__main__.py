"""What forecasts as they were issued are worth: ``python test/real_seasons ARCHIVES -o DIR``.

ARCHIVES is a directory with the previous runs of three services and the gauge's record beside them,
2024-02-20 to 12-31 at Budva. On the paper's roof and on a measured one, both with mains, it runs
on/off, and ``lookahead`` with a forecast of no rain, of each service, of the three as one ensemble,
of a placebo, and a perfect one: as issued, with trust that is learned, and dressed. A study in DIR
does the runs; the same command goes on where it was. Prints a table in Markdown, and draws trust
over time.

Assumed: evapotranspiration is the site file's monthly mean as a half sine over the day. Hours that
the gauge lacks count as dry. GFS's fifth day is left out. The placebo is GEM's issues of 35 days
later, and at the end those of the first weeks: as wet, and without skill. Dressed forecasts are
made of the same record, without the days around each issue
(:mod:`greenroof_ros.forecast.dressing`).
"""

from __future__ import annotations

import argparse
import csv
import math
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import altair as alt
import numpy as np
import vl_convert
import yaml
from numpy.typing import NDArray

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent.parent)]

from dressing.__main__ import together  # noqa: E402

from greenroof_ros.common.files import shared_directory  # noqa: E402
from greenroof_ros.controllers.registry import find_controller  # noqa: E402
from greenroof_ros.experiment.closed_loop import closed_loop  # noqa: E402
from greenroof_ros.experiment.run import build_run, count_ticks  # noqa: E402
from greenroof_ros.forecast.choice import choose  # noqa: E402
from greenroof_ros.forecast.dressing import dressing_text, learn  # noqa: E402
from greenroof_ros.formats.own_csv import write_forecasts  # noqa: E402
from greenroof_ros.formats.reading import read_archive  # noqa: E402
from greenroof_ros.formats.records import SERVICE_DELAY_H, Archive  # noqa: E402
from greenroof_ros.model.initial_state import initial_state  # noqa: E402
from greenroof_ros.model.metrics import Metrics  # noqa: E402
from greenroof_ros.model.site import Site, edited, read_site  # noqa: E402
from greenroof_ros.report.drawing import COLOURS, CONFIG  # noqa: E402
from greenroof_ros.weather.reading import read_weather  # noqa: E402

Array = NDArray[np.float64]

SERVICES = {"gem": "gem_global", "knmi": "knmi_seamless", "gfs": "gfs_seamless"}
# Start and hours of the runs: as far as the archives go, and a season that begins with a dry roof.
# After the winter's rain the paper's roof, which drains when it is full only, stays full until
# September: in the whole year there is little to decide.
PERIODS = {
    "20 February to 31 December": (datetime(2024, 2, 20, 12, tzinfo=timezone.utc), 7548.0),
    "May to October": (datetime(2024, 5, 1, tzinfo=timezone.utc), 4416.0),
}
# The roofs, and so many hours a dressed forecast has on each: as far as its controllers look.
ROOFS = {"paper": ("site.yaml", 120.0), "measured": ("site_catchment.yaml", 48.0)}
MAINS = {"mains_level": 0.85, "mains_flow": 5e-4}
TICK_S = 60.0
# A twentieth of the flow lifts in a tick of a minute what on/off lifts in three seconds.
FRACTION = 0.05
PLACEBO_DAYS = 35
# Of the bootstrap: blocks of weeks, since a storm's excess stays for more than one.
RESAMPLES, BLOCK_WEEKS = 2000, 4


def half_sine(hour: int) -> float:
    """Return the share of a day's mean that evaporates in an hour of UTC; the sun is up from 5."""
    return math.pi * max(0.0, math.sin(math.pi * (hour + 0.5 - 5) / 12))


def write_inputs(archives: Path, directory: Path) -> None:
    """Write weather, sites, forecasts, what dresses them, and grids into a directory."""
    site = read_site(shared_directory() / "config" / ROOFS["measured"][0])
    gauge = directory / "gauge.csv"
    gauge.write_text(_gauge(archives / "gauge_2024.csv", site), encoding="utf-8")
    record = read_weather([gauge], site, rain_only=True)
    services = {
        short: read_archive(archives / f"{name}_previous_runs.csv", site)
        for short, name in SERVICES.items()
    }
    services["gfs"] = shortened(services["gfs"], 96)
    all_of = {
        **services, "three": together(list(services.values())),
        "placebo": shifted(services["gem"]),
    }
    dry = [replace(issue, rain=0 * issue.rain) for issue in services["gem"].issues]
    (directory / "no_rain.csv").write_text(write_forecasts(dry), encoding="utf-8")
    for name, archive in all_of.items():
        (directory / f"{name}.csv").write_text(write_forecasts(archive.issues), encoding="utf-8")
    for roof, (name, horizon) in ROOFS.items():
        text = (shared_directory() / "config" / name).read_text(encoding="utf-8")
        mains = {} if "mains_flow" in text else MAINS
        (directory / f"{roof}.yaml").write_text(
            edited(text, {"tau": TICK_S, "M": 1, **mains}), encoding="utf-8"
        )
        for source, archive in all_of.items():
            (directory / f"dressed_{source}_{roof}.csv").write_text(
                dressing_text(learn(archive, record, round(horizon))), encoding="utf-8"
            )
        (directory / f"grid_{roof}.yaml").write_text(
            yaml.safe_dump(grid(roof, list(all_of)), sort_keys=False), encoding="utf-8"
        )


def grid(roof: str, sources: Sequence[str]) -> dict[str, object]:
    """Return the grid of a roof."""
    raw = [{"model": f"{source}.csv", "delay": SERVICE_DELAY_H} for source in sources]
    dressed = [
        {**one, "dressed": f"dressed_{source}_{roof}.csv"}
        for source, one in zip(sources, raw, strict=True)
    ]
    return {
        "site": f"{roof}.yaml",
        "weather": [
            {
                "file": "gauge.csv", "start": start.isoformat(), "hours": hours, "gaps": "fill",
                "evapotranspiration": "assumed",
            }
            for start, hours in PERIODS.values()
        ],
        "initial": "low-low",
        "bound_block": 0,
        "controllers": {
            "onoff": {"fraction": FRACTION, "forecast": "perfect"},
            "lookahead": [
                {"trust_memory": 0.0, "forecast": ["perfect", "no_rain.csv", *raw, *dressed]},
                {"forecast": [*raw, *dressed]},
            ],
        },
    }


def _gauge(file: Path, site: Site) -> str:
    """Return the gauge's record with the evapotranspiration that is assumed (mm/day)."""
    monthly = site.monthly_evapotranspiration
    assert monthly is not None
    lines = ["time,precipitation [mm/h],assumed evapotranspiration [mm/day]"]
    with file.open(encoding="utf-8") as stream:
        for time, rain in list(csv.reader(stream))[1:]:
            begins = datetime.fromisoformat(time).replace(tzinfo=timezone.utc)
            dries = monthly[begins.month - 1] * half_sine(begins.hour)
            lines.append(f"{begins.isoformat()},{rain},{dries:.4f}")
    return "\n".join([*lines, ""])


def shortened(archive: Archive, hours: int) -> Archive:
    """Return an archive to so many hours."""
    return replace(archive, issues=tuple(
        replace(issue, rain=issue.rain[:, :hours]) for issue in archive.issues
    ))


def shifted(archive: Archive) -> Archive:
    """Return each issue with what was forecast weeks later."""
    count = PLACEBO_DAYS * round(timedelta(days=1) / (
        archive.issues[1].issued - archive.issues[0].issued
    ))
    moved = [*archive.issues[count:], *archive.issues[:count]]
    return replace(archive, issues=tuple(
        replace(issue, rain=other.rain) for issue, other in zip(archive.issues, moved, strict=True)
    ))


@dataclass(frozen=True)
class Row:
    """A run: how it was decided, and the deviation of each of its weeks (m3)."""

    forecast: str
    trusts: bool
    dressed: bool
    weeks: Array


def rows(study: Path, hours: float) -> list[Row]:
    """Return the runs of a study that have so many hours."""
    with (study / "results.csv").open(encoding="utf-8") as stream:
        return [
            Row(
                "on/off" if row["controller"] == "onoff" else Path(row["forecast"]).stem,
                row["parameter:trust_memory"] not in ("", "0", "0.0"),
                bool(row["forecast_dressed"]),
                np.array([float(value) for value in row["weekly_deviation_m3"].split()]),
            )
            for row in csv.DictReader(stream)
            if float(row["hours"]) == hours
        ]


def ratio(own: Array, other: Array) -> str:
    """Return a sum over weeks over another's, with its 95 % interval by blocks of weeks."""
    random = np.random.default_rng(1)
    blocks = -(-len(own) // BLOCK_WEEKS)
    begins = random.integers(len(own), size=(RESAMPLES, blocks))
    drawn = (begins[..., None] + np.arange(BLOCK_WEEKS)).reshape(RESAMPLES, -1) % len(own)
    drawn = drawn[:, : len(own)]
    ratios = own[drawn].sum(axis=1) / other[drawn].sum(axis=1)
    low, high = np.percentile(ratios, [2.5, 97.5])
    return f"{own.sum() / other.sum():.3f} ({low:.3f} to {high:.3f})"


def table(found: Sequence[Row]) -> Iterator[str]:
    """Yield the rows of the table of a roof in a period.

    Forecasts that are trusted in full have a row of their own where that changes anything.
    """
    runs = {(one.forecast, one.trusts, one.dressed): one.weeks for one in found}
    onoff, dry, perfect = (runs[name, False, False] for name in ("on/off", "no_rain", "perfect"))
    for forecast, trusts in dict.fromkeys((one.forecast, one.trusts) for one in found):
        ours = [runs.get((forecast, trusts, dressed)) for dressed in (False, True)]
        learned = [runs.get((forecast, True, dressed)) for dressed in (False, True)]
        if not trusts and all(map(np.array_equal, ours, learned)):
            continue
        cells = [forecast + (", trusted in full" if learned[0] is not None and not trusts else "")]
        for own in ours:
            if own is None:
                cells += [""] * 3
                continue
            gained = (dry.sum() - own.sum()) / (dry.sum() - perfect.sum())
            cells += [ratio(own, onoff), ratio(own, dry), f"{100 * gained:+.0f} %"]
        yield f"| {' | '.join(cells)} |"


def trust_over_time(directory: Path, roof: str, source: str) -> Array:
    """Return how far a roof's controller trusts the forecasts of a source, at each day's start."""
    site_file = directory / f"{roof}.yaml"
    site = read_site(site_file)
    weather = read_weather([directory / "gauge.csv"], site, "assumed", "fill")
    controller = find_controller("lookahead")
    start, hours = PERIODS["May to October"]
    run = build_run(
        site_file, site, weather, start.isoformat(), count_ticks(site, hours, "hours"),
        controller, controller.defaults(site), "low-low", initial_state(site, "low-low"),
        replace(choose(str(directory / f"{source}.csv")), delay=SERVICE_DELAY_H),
    )
    made, day, trust = run.make_controller(), round(86_400 / site.tau), []
    for tick in closed_loop(run, made, Metrics()):
        if tick.k % day == 0:
            trust.append(made.trust)
    return np.array(trust)


def draw_trust(output: Path) -> None:
    """Draw how far each roof's controller trusts each source, over the months."""
    first, _ = PERIODS["May to October"]
    values = [
        {
            "day": (first + timedelta(days=day)).isoformat(), "trust (%)": 100 * trust,
            "forecast": source, "roof": roof,
        }
        for roof in ROOFS
        for source in ("gem", "knmi", "gfs", "three", "placebo")
        for day, trust in enumerate(trust_over_time(output / "inputs", roof, source).tolist())
    ]
    chart = alt.Chart(alt.Data(values=values)).mark_line(interpolate="step-after").encode(
        x=alt.X("day:T", title=None), y=alt.Y("trust (%):Q"),
        color=alt.Color("forecast:N", scale=alt.Scale(range=list(COLOURS))), row="roof:N",
        strokeDash="forecast:N",
    ).properties(width=600, height=120).configure(**CONFIG)
    (output / "trust.svg").write_text(vl_convert.vegalite_to_svg(chart.to_dict()), encoding="utf-8")


def main() -> None:
    """Run the studies, and print and draw what they found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("archives", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    arguments = parser.parse_args()
    inputs = arguments.output / "inputs"
    if not inputs.exists():
        inputs.mkdir(parents=True)
        write_inputs(arguments.archives, inputs)
    three = "over on/off | over no rain | gained"
    heads = f"| forecast | as issued: {three} | dressed: {three} |\n|---|---|---|---|---|---|---|"
    for roof in ROOFS:
        study = arguments.output / roof
        subprocess.run(
            [
                sys.executable, "-m", "greenroof_ros.study", str(inputs / f"grid_{roof}.yaml"),
                "--no-trajectories", "--output", str(study),
            ],
            check=True,
        )
        for words, (_, hours) in PERIODS.items():
            print(f"\n{roof}, {words}\n\n{heads}")
            for line in table(rows(study, hours)):
                print(line, flush=True)
    draw_trust(arguments.output)


if __name__ == "__main__":
    main()
