"""How often the true parameters of twins lie in the stated intervals.

``python test/calibration/recover_twins.py``: ten years of five-minute records, each with noise and
gaps and its own weather, fitted from a start far from the truth. Takes ten minutes.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent.parent)]

from twins import FILLED_AT_FIRST, TWIN, record_rows, write  # noqa: E402

from greenroof_ros.calibration.csv_record import read_csv_record  # noqa: E402
from greenroof_ros.calibration.fit import FILLED, Parameter, fit  # noqa: E402
from greenroof_ros.calibration.storms import comparable  # noqa: E402
from greenroof_ros.calibration.suspicions import refuse_wrong  # noqa: E402

ELSEWHERE = replace(
    TWIN, field_capacity=0.3, z_cap=3.0, wilting_point=0.02, depletion_fraction=0.5,
    drainage_time=300.0, crop_coefficient=1.0,
)
"""Where the fit begins."""


def true_value(name: str) -> float:
    """Return what the twin's parameter is."""
    return FILLED_AT_FIRST if name == FILLED else float(getattr(TWIN, name))


def recover(days: int, seed: int, scratch: Path) -> list[Parameter]:
    """Return the parameters fitted to a twin's record."""
    rows = record_rows(TWIN, days, seed, tick_s=1.0)
    record = read_csv_record(write(rows, scratch / "twin.csv"), TWIN)
    refuse_wrong(record, TWIN)
    return fit(ELSEWHERE, record, comparable(record)).parameters


def main() -> None:
    """Print what was recovered, seed by seed, and how often the truth lies within."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--days", type=int, default=365)
    arguments = parser.parse_args()
    within: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as scratch:
        for seed in range(1, arguments.seeds + 1):
            for one in recover(arguments.days, seed, Path(scratch)):
                true = true_value(one.name)
                inside = one.told and one.low <= true <= one.high
                mark = "" if inside else "outside"
                within[one.name] = within.get(one.name, 0) + inside
                print(f"{seed:3} {one.name:20} {true:9.4g} {one.value:9.4g} "
                      f"{one.low:9.4g} to {one.high:9.4g} {mark}", flush=True)
    for name, count in within.items():
        print(f"{name}: within its interval in {count} of {arguments.seeds} seeds")


if __name__ == "__main__":
    main()
