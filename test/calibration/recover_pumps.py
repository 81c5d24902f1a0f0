"""How often the true flow of twins' pumps lies in the stated interval.

``python test/calibration/recover_pumps.py --days 7``: records of a week, each with its own weather
and noise, as they are, with a pump state that is a step late, and with a refill a week. Counted are
the first hundred seeds with ten runs and more.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parent.parent)]

from test_pump import SITE, later, twin  # noqa: E402

from greenroof_ros.calibration.pump import fit_pump  # noqa: E402
from greenroof_ros.model.plant import maximum_pump_flow  # noqa: E402

WORN = replace(SITE, c_hat=48.0)


def main() -> None:
    """Print, for each case, how often the truth lies within, and how far off the flow is."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--days", type=int, default=7)
    parser.add_argument("--records", type=int, default=100)
    arguments = parser.parse_args()
    found: dict[str, list[tuple[float, float]]] = {"clean": [], "late": [], "refill": []}
    for seed in itertools.count(1):
        clean = twin(WORN, arguments.days, seed)
        refilled = twin(WORN, arguments.days, seed, refills=True)
        for case, record in (("clean", clean), ("late", later(clean, 1)), ("refill", refilled)):
            pump = fit_pump(SITE, record)
            if pump is not None and len(found[case]) < arguments.records:
                true = maximum_pump_flow(WORN, pump.level * SITE.a1)
                found[case].append((abs(pump.flow - true) / true, pump.half / true))
        if all(len(fits) == arguments.records for fits in found.values()):
            break
    for case, fits in found.items():
        off, half = np.array(fits).T
        within = np.count_nonzero(off <= half)
        print(
            f"{arguments.days} days, {case}: within its interval in {within} of {len(off)} "
            f"records, median error {100 * np.median(off):.2f} %, median half of the "
            f"interval {100 * np.median(half):.2f} %"
        )


if __name__ == "__main__":
    main()
