"""What each size of cistern and green roof gives its owner: ``python tools/sizing STUDY``.

STUDY is the output of 'greenroof study config/studies/sizing.yaml'. Prints a table in Markdown: the
mean season, with the 95 % confidence interval of the mean over the years (Student's t).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import polars as pl
from scipy.special import stdtrit

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import paths  # noqa: F401
from markdown_tables import head, row

from greenroof_ros.model.site import read_site

METRICS = {
    "saved_m3": ("mains water saved (m³)", ".1f"),
    "mains_m3": ("mains water used (m³)", ".1f"),
    "outflow_m3": ("lost to the sewer (m³)", ".1f"),
    "stress_hours": ("water stress (h)", ".0f"),
    "evapotranspiration_ratio": ("actual over potential evapotranspiration", ".3f"),
    "rain_kept_share": ("rain kept on the roof", ".2f"),
    "mean_deviation_mm": ("mean deviation (mm)", ".1f"),
}


def interval(values: pl.Series) -> tuple[float, float, float]:
    """Return a mean over years, and the ends of its 95 % interval."""
    middle, count = values.mean(), values.count()
    wide = stdtrit(count - 1, 0.975) * values.std() / count**0.5
    return middle, middle - wide, middle + wide


def mean(values: pl.Series, form: str) -> str:
    """Return it as a cell."""
    return "{} ({} to {})".format(*(f"{value:{form}}" for value in interval(values)))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", type=Path, metavar="STUDY")
    study = parser.parse_args().study
    seasons = pl.read_csv(study / "results.csv")
    names = seasons["site"].unique().to_list()
    sites = [read_site(study / "configuration" / name) for name in names]
    sizes = pl.DataFrame({
        "site": names, "roof": [site.a2 for site in sites],
        "cistern": [site.a1 * site.z_o for site in sites],
    })
    print(head([
        "begins", "green roof (m²)", "cistern (m³)", *(title for title, _ in METRICS.values()),
    ]))
    cases = seasons.join(sizes, on="site").sort("initial", "roof", "cistern")
    for (initial, *size), years in cases.group_by(
        "initial", "roof", "cistern", maintain_order=True
    ):
        print(row([
            initial, *(f"{value:g}" for value in size),
            *(mean(years[name], form) for name, (_, form) in METRICS.items()),
        ]))


if __name__ == "__main__":
    main()
