"""What forecasts that were made to do harm cost in a season: ``python test/adversaries RECORDS``.

Each controller that looks ahead, with its default budget, from May to October, is told each of
seven such forecasts, ten days long; lookahead also all of them at once, as an ensemble. Printed is
its deviation over that of plain on/off, and the stated bound likewise, for Table I's roof and for
a measured one with a catchment. RECORDS has the hourly bulk files of Toronto City Centre. Ticks
are of a minute, and the pumps have a twentieth of their flow, or on/off would lift 7 mm in one.
Exits with 1 where a bound does not hold.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.progress import track

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent.parent)]

from adversaries.forecasts import ADVERSARIES, TOGETHER, told  # noqa: E402
from paper import paper_run, site_file  # noqa: E402

from greenroof_ros.experiment.closed_loop import closed_loop  # noqa: E402
from greenroof_ros.experiment.run import Run  # noqa: E402
from greenroof_ros.model.metrics import Metrics  # noqa: E402

SITES = ("site.yaml", "site_catchment.yaml")
CONTROLLERS = ("anticipating_onoff", "lookahead")
HORIZON_H, TICK_S, STRENGTH = 240, 60.0, 0.05
BUDGET_H, SHARE = 72.0, 0.05  # the defaults
TARGET_M = 0.0457  # of both roofs


class Case(NamedTuple):
    """One season of one controller."""

    site: str
    year: int
    controller: str
    forecast: str


class Season(NamedTuple):
    """What came of it."""

    deviation: float
    """m3 s"""
    overflowed: float
    """from the cistern (m3)"""
    empty: float
    """time with too little in the cistern to pump (s)"""
    empty_roof: float
    """what an hour with an empty roof costs (m3 s)"""


def run_of(case: Case, records: Path, directory: Path) -> Run:
    """Build a run with its true forecast."""
    strength = "--max-command" if case.controller == "lookahead" else "--fraction"
    look = () if case.controller == "onoff" else ("--horizon", str(HORIZON_H))
    run = paper_run(
        "--site", str(site_file(directory, base=case.site, z_veg=TARGET_M, tau=TICK_S, M=1)),
        "--controller", case.controller, strength, str(STRENGTH), *look,
        "--weather", f"{records}/{case.year}_*.csv", "--gaps", "fill", "--evapotranspiration",
        "fao56", "--start", f"{case.year}-05-01T00:00", "--hours", "4416", "--initial", "low-low",
    )
    return run if case.controller == "onoff" else told(run, case.forecast, HORIZON_H)


def season(case: Case, records: Path) -> Season:
    """Run it."""
    with tempfile.TemporaryDirectory() as directory:
        run = run_of(case, records, Path(directory))
    site, metrics = run.site, Metrics()
    overflowed = empty = 0.0
    for tick in closed_loop(run, run.make_controller(), metrics):
        overflowed += site.tau * tick.flows.outflow
        empty += site.tau * (tick.cistern_level < site.suction_level)
    return Season(
        metrics["total_deviation_m3"] * site.tau, overflowed, empty, 3600 * site.x2_star
    )


def main() -> int:
    """Run all, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("records", type=Path)
    parser.add_argument("--year", type=int, default=2022)
    parser.add_argument("--site", choices=SITES, nargs="*", default=SITES)
    arguments = parser.parse_args()
    cases = [
        Case(site, arguments.year, controller, forecast)
        for site in arguments.site
        for controller, forecasts in
        (("onoff", ("",)), *((controller, ADVERSARIES) for controller in CONTROLLERS),
         ("lookahead", (TOGETHER,)))
        for forecast in forecasts
    ]
    with ProcessPoolExecutor() as pool:
        done = pool.map(season, cases, [arguments.records] * len(cases))
        shown = track(done, "seasons", len(cases), console=Console(stderr=True))
        found = dict(zip(cases, shown, strict=True))
    broken = 0
    for site in arguments.site:
        plain = found[Case(site, arguments.year, "onoff", "")]
        bound = (1 + SHARE) * plain.deviation + BUDGET_H * plain.empty_roof
        print(f"\n{site}, {arguments.year}: onoff {plain.deviation:.0f} m3 s, the bound "
              f"{bound / plain.deviation:.3f} of it\n")
        print("| forecast | " + " | ".join(CONTROLLERS) + " |")
        print("|---" * (1 + len(CONTROLLERS)) + "|")
        for forecast in (*ADVERSARIES, TOGETHER):
            cells = []
            for controller in CONTROLLERS:
                one = found.get(Case(site, arguments.year, controller, forecast))
                if one is None:
                    cells.append("")
                    continue
                # What an overflow took while it waited is missing as long as the cistern is empty.
                lacking = max(0.0, one.overflowed - plain.overflowed) * one.empty
                beyond = one.deviation > bound
                broken += one.deviation > bound + lacking
                note = f" (limit {(bound + lacking) / plain.deviation:.3f})" if beyond else ""
                cells.append(f"{one.deviation / plain.deviation:.3f}{note}")
            print(f"| {forecast} | " + " | ".join(cells) + " |")
    return int(broken > 0)


if __name__ == "__main__":
    sys.exit(main())
