"""What each size of cistern and green roof gives its owner: ``python tools/sizing STUDY``.

STUDY is what 'greenroof study config/studies/sizing.yaml' has made. Prints a table in Markdown:
means of a season, and the 95 % interval of a mean of as many years, by Student's t.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
from scipy.special import stdtrit

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import paths  # noqa: F401

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


def mean(values: list[float], form: str) -> str:
    """Return a mean over years, with its 95 % interval."""
    count = len(values)
    wide = stdtrit(count - 1, 0.975) * np.std(values, ddof=1) / np.sqrt(count)
    middle = np.mean(values)
    return f"{middle:{form}} ({middle - wide:{form}} to {middle + wide:{form}})"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", type=Path, metavar="STUDY")
    study = parser.parse_args().study
    years: dict[tuple[str, float, float], list[dict[str, str]]] = defaultdict(list)
    with (study / "results.csv").open(encoding="utf-8") as stream:
        for row in csv.DictReader(stream):
            site = read_site(study / "configuration" / row["site"])
            years[row["initial"], site.a2, site.a1 * site.z_o].append(row)
    heads = ["begins", "green roof (m²)", "cistern (m³)", *(head for head, _ in METRICS.values())]
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    for case in sorted(years):
        initial, *size = case
        cells = [initial, *(f"{each:g}" for each in size)]
        cells += [
            mean([float(row[name]) for row in years[case]], form)
            for name, (_, form) in METRICS.items()
        ]
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
