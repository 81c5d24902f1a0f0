"""The exponent of percolation: which ones the half of a record that was not fitted tells apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from greenroof_ros.analysis.calibration.fit import Fit, FittedParameter, UpdateProgress, fit
from greenroof_ros.analysis.calibration.scores import score
from greenroof_ros.analysis.calibration.step_record import HOUR_S, StepRecord, Steps
from greenroof_ros.site.site import Site

EXPONENT = "percolation_exponent"
EXPONENTS = (1.0, 1.5, 2.0, 3.0, 5.0)
"""exponents that are compared, in addition to that of the site"""
ALIKE = 0.05
"""difference in the NSE of the validation up to which exponents are not told apart"""


class ExponentFit(NamedTuple):
    """The fit with an exponent."""

    exponent: float
    nse: float
    """NSE of hours (or longer steps) in the validation, the mean over the measured quantities"""
    fit: Fit


def fit_exponents(
    site: Site, record: StepRecord, halves: Mapping[str, Steps],
    update_progress: UpdateProgress = lambda text, share: None,
    exponents: Sequence[float] = EXPONENTS,
) -> list[ExponentFit]:
    """Fit a roof with each exponent of percolation, in ascending order.

    The exponent changes the shape of the soil's response, for which the other parameters can make
    up in the half that they are fitted to. Therefore exponents are compared in the other half.

    Args:
        site: as for :func:`.fit.fit`.
        record: the measurements.
        halves: the steps that are fitted, and the steps for validation.
        update_progress: callback that receives the progress before every simulation.
        exponents: exponents to compare.
    """
    fits: list[ExponentFit] = []
    for number, exponent in enumerate(exponents):
        def show(text: str, share: float, number: int = number) -> None:
            update_progress(
                f"exponent {exponents[number]:g}: {text}", (number + share) / len(exponents)
            )

        fitted = fit(
            replace(site, percolation_exponent=exponent), record, halves["fit"], show,
            fits[-1].fit if fits else None,
        )
        fits.append(ExponentFit(exponent, _validate(fitted, record, halves["validation"]), fitted))
    update_progress("done", 1.0)
    return fits


def _validate(fitted: Fit, record: StepRecord, steps: Steps) -> float:
    scores = [
        score(
            name, "validation", getattr(fitted.simulated, name)[steps], series[steps],
            record.seconds[steps], record.step_s,
        )
        for name, series in record.measured.items()
    ]
    return float(np.nanmean([
        next(nse for span_s, nse in row.nse.items() if span_s >= HOUR_S) for row in scores
    ]))


def choose_exponent(fits: Sequence[ExponentFit], own: float) -> tuple[Fit, str]:
    """Return the fit to use, with the exponent among its parameters, and a note on the others.

    The validation does not tell exponents apart whose NSE is within 0.05 of the best, because it
    depends on a few storms. If the site's own exponent is among them, it is kept; otherwise, the
    best exponent is used. Between the exponents that were compared, the NSE is interpolated.

    Args:
        fits: fits with each exponent, including the site's own, in ascending order.
        own: exponent of the site.
    """
    best = max(fits, key=lambda each: each.nse)
    limit = best.nse - ALIKE
    alike = [place for place, each in enumerate(fits) if each.nse >= limit]
    chosen = next((fits[place] for place in alike if fits[place].exponent == own), best)
    low, high = (
        float(np.interp(limit, [outside.nse, last.nse], [outside.exponent, last.exponent]))
        for outside, last in (
            (fits[max(0, alike[0] - 1)], fits[alike[0]]),
            (fits[min(alike[-1] + 1, len(fits) - 1)], fits[alike[-1]]),
        )
    )
    parameter = FittedParameter(
        EXPONENT, chosen.exponent, low, high,
        "not a 95 % interval: the validation does not tell these exponents apart",
    )
    tried = ", ".join(f"{each.nse:.2f} with {each.exponent:g}" for each in fits)
    return (
        chosen.fit._replace(parameters=[*chosen.fit.parameters, parameter]),
        f"{EXPONENT}: the NSE in the validation is {tried}; exponents within {ALIKE:g} of the best "
        "are not told apart",
    )
