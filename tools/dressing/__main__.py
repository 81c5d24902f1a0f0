"""What dressing is worth for records that it was not fitted to.

``python tools/dressing ARCHIVE ... --weather GAUGE``

The months of the records are divided by their rain into a wetter and a drier half. Archives are
dressed by the rain of one half and judged on the other, then the other way round. Last come all
archives as one ensemble, and the whole period, where each issue is dressed without the days around
it. ``ARCHIVE@96`` cuts an archive to 96 h. Prints a table in Markdown: for each sum the bias, and
the fair CRPS (mm), as issued, dressed, and by climatology.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import paths  # noqa: F401
from markdown_tables import head, row

from greenroof_ros.common.files import shared_directory
from greenroof_ros.forecast.dressing import learn
from greenroof_ros.formats.reading import read_archive
from greenroof_ros.formats.records import HOUR, Archive
from greenroof_ros.model.site import read_site
from greenroof_ros.verification.dressed import worth
from greenroof_ros.weather.reading import find_files, read_weather
from greenroof_ros.weather.series import Weather


def halves(weather: Weather, archives: list[Archive]) -> tuple[Weather, Weather]:
    """Return the records of the drier and of the wetter months, by their totals.

    Hours before the first issue that all archives have, and in the other months, are missing.
    """
    rain = weather.precipitation
    times = [weather.rain_from + hour * HOUR for hour in range(len(rain))]
    begin = max(archive.issues[0].issued for archive in archives)
    month = np.array([time.year * 12 + time.month if time >= begin else 0 for time in times])
    months = sorted(set(month[month > 0]), key=lambda number: np.nansum(rain[month == number]))
    drier = np.isin(month, months[: (len(months) + 1) // 2])
    return (
        replace(weather, values={"precipitation": np.where(drier, rain, np.nan)}),
        replace(weather, values={"precipitation": np.where(drier | (month == 0), np.nan, rain)}),
    )


def together(archives: list[Archive]) -> Archive:
    """Return the issues common to all archives as one ensemble, cut to the shortest of them."""
    by_time = [{issue.issued: issue for issue in archive.issues} for archive in archives]
    issues = []
    for issue in archives[0].issues:
        alike = [times[issue.issued] for times in by_time if issue.issued in times]
        if len(alike) == len(archives):
            hours = min(past.hours for past in alike)
            rain_of_all = np.vstack([past.rain[:, :hours] for past in alike])
            issues.append(replace(issue, rain=rain_of_all))
    return replace(archives[0], source=Path("all as one ensemble"), issues=tuple(issues))


def shortened(archive: Archive, hours: int) -> Archive:
    """Return an archive cut to a number of hours."""
    return replace(archive, issues=tuple(
        replace(issue, rain=issue.rain[:, :hours]) for issue in archive.issues
    ))


def archive(text: str) -> Archive:
    """Read an archive, cut to a number of hours if the text has one."""
    path, _, hours = text.partition("@")
    past = read_archive(Path(path), read_site(shared_directory() / "config" / "site.yaml"))
    return replace(shortened(past, int(hours or 10_000)), source=Path(Path(path).stem))


def lines(archives: list[Archive], weather: Weather) -> Iterator[str]:
    """Yield the rows of the table."""
    drier, wetter = halves(weather, archives)
    rain = np.where(np.isnan(drier.precipitation), wetter.precipitation, drier.precipitation)
    both = replace(weather, values={"precipitation": rain})
    if len(archives) > 1:
        archives = [*archives, together(archives)]
    for fit, judge, words in (
        (drier, wetter, "dry, wet"), (wetter, drier, "wet, dry"), (both, both, "all, all"),
    ):
        for service in archives:
            for scores in worth(service, learn(service, fit, 120), judge, lambda _: None):
                yield row([
                    words, str(service.source), f"{scores.hours} h", str(scores.n),
                    f"{scores.fell:.1f}", *(f"{x:.2f}" for x in (*scores.bias, *scores.crps)),
                ])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("archives", nargs="+", type=archive)
    parser.add_argument("--weather", nargs="+", required=True)
    arguments = parser.parse_args()
    site = read_site(shared_directory() / "config" / "site.yaml")
    weather = read_weather(find_files(arguments.weather, "--weather"), site, rain_only=True)
    heads = ["fit, judged", "forecasts", "sum", "n", "observed mm"]
    for what in ("bias", "CRPS"):
        heads += [f"{what} issued", "dressed", "climate"]
    print(head(heads))
    for line in lines(arguments.archives, weather):
        print(line, flush=True)


if __name__ == "__main__":
    main()
