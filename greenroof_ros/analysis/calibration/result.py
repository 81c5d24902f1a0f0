"""A calibration: the fit of a site's roof to a record, its scores, and the new site file."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from greenroof_ros.analysis.calibration.fit import (
    EXPONENTS,
    Fit,
    UpdateProgress,
    choose_exponent,
    fit_exponents,
)
from greenroof_ros.analysis.calibration.record import (
    DAY_S,
    FitScores,
    StepRecord,
    Steps,
    halve_steps,
    read_bag_record,
    read_csv_record,
    select_months,
)
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.times import duration
from greenroof_ros.site.file import format_site, read_site
from greenroof_ros.site.site import Site

INTERVAL_NOTE = (
    "The 95 % intervals include the effect of parameters that the record does not determine. These "
    "and all that was not fitted have the values of the original site file."
)
"""what the intervals of fitted parameters cover"""

# In m: drainage mats and gravel have 0.002 to 0.04. An ordinary storm does not fill it.
_TYPICAL_STORAGE = 0.02
# Share of the plants' available water that may be used up: 'a value of 0.50 for p is commonly used
# for many crops' (FAO-56, chapter 8).
_DEPLETION = 0.5


@dataclass(frozen=True)
class Calibration:
    """A roof that was fitted to the first half of a record's rain, and validated on the second.

    Attributes:
        fit: the fitted site, its parameters, the record as simulated, and the scores of every
            quantity in either half.
        site_file: text of the site file of the fitted site.
        record: the measurements.
        halves: steps of the record that were fitted (``fit``) and validated (``validation``).
        notes: findings for the reader.
    """

    fit: Fit
    site_file: str
    record: StepRecord
    halves: Mapping[str, Steps]
    notes: Sequence[str]


def calibrate(
    measured: str | os.PathLike[str], site: str | os.PathLike[str], months: str | None = None,
    progress: UpdateProgress = lambda text, share: None,
) -> Calibration:
    """Fit a site's roof to a measured record, like ``greenroof calibrate``.

    Args:
        measured: a CSV file, a bag or an ``.mcap`` file with the measurements.
        site: site file from which the fit starts.
        months: months of the record to use, such as ``4-10``; by default all.
        progress: callback that receives the current task, and the share that is done.

    Raises:
        ConfigurationError: if the record or the site is invalid.

    Example:
        >>> import greenroof_ros as gr
        >>> made = gr.calibrate("roof_2025.csv", "my_site.yaml")  # doctest: +SKIP
        >>> made.fit.site.field_capacity, made.fit.scores  # doctest: +SKIP
    """
    file, source = Path(site), Path(measured)
    start = complete_roof(read_site(file))
    is_bag = source.is_dir() or source.suffix.lower() == ".mcap"
    record = (read_bag_record if is_bag else read_csv_record)(source, start)
    halves = halve_steps(record, select_months(record, months))
    check_record(record, halves)
    own = start.percolation_exponent
    fits = fit_exponents(start, record, halves, progress, sorted({*EXPONENTS, own}))
    fitted, of_exponents = choose_exponent(fits, own)
    fitted = fitted._replace(site=lower_target(fitted.site))
    notes = [*record.notes, *_list_notes(record, halves, start, fitted.site), of_exponents]
    heading = [
        f"Fitted to {source.name} by greenroof calibrate.",
        *map(describe_scores, fitted.scores), INTERVAL_NOTE, *notes,
    ]
    text = format_fitted_site(file, fitted, start.z_veg, heading)
    return Calibration(fitted, text, record, halves, notes)


def complete_roof(site: Site) -> Site:
    """Return a site with field-capacity soil, using typical values for missing parameters."""
    if site.field_capacity is None:
        site = replace(
            site, field_capacity=0.35, wilting_point=0.02, depletion_fraction=0.5,
            z_cap=site.a2 * site.z_soil * 0.35,
        )
    if site.drainage_storage is None:
        site = replace(site, drainage_storage=_TYPICAL_STORAGE, drainage_time=600.0)
    return site


def lower_target(site: Site) -> Site:
    """Return the site, with a lower target if its roof cannot hold the current target.

    Water above field capacity drains, so the pumps would never reach a target above it. Because a
    record says nothing about the target, the target is set half-way between wilting point and field
    capacity, and the site's owner is asked to choose another target.

    Args:
        site: site with field-capacity soil.
    """
    if site.x2_star < site.z_cap:
        return site
    volume = site.wilting_volume + (1 - _DEPLETION) * site.available_volume
    depth = float(f"{volume / site.a2:.6g}")  # with as many digits as the site file
    return replace(site, z_veg=depth, x2_star=site.a2 * depth)


def check_record(record: StepRecord, halves: Mapping[str, Steps]) -> None:
    """Reject a record with nothing to fit or to validate.

    Args:
        record: the measurements.
        halves: the steps of the fit, and those of the validation.

    Raises:
        ConfigurationError: if no measured quantity changes in a half.
    """
    for steps in halves.values():
        if all(len(np.unique(each[steps])) < 2 for each in record.measured.values()):
            raise ConfigurationError(
                "in a half of its rain, no measured quantity changes, but fit and validation both "
                "need changes in runoff or levels; leave out the dry rows at the end, or use a "
                "longer record with fewer gaps: after more than an hour with unknown rain, pumped "
                "water or evapotranspiration, at least a week is left out", file=record.source,
            )


def format_fitted_site(file: Path, fit: Fit, target: float, heading: Sequence[str]) -> str:
    """Return the text of a complete site file with fitted values.

    Every value has its interval, or the reason why it is not identified, as a comment.

    Args:
        file: path of the original site file.
        fit: result of the fit.
        target: target depth on the roof (m) in the original site file.
        heading: paragraphs of comments for the top of the file.
    """
    reasons = dict.fromkeys(("drainage_storage", "drainage_time"), "unchanged, not fitted") | {
        one.name: " ".join(filter(None, (
            f"fitted, {one.interval};" if one.interval else "unchanged:", one.reason
        ))).removesuffix(";") for one in fit.parameters
    }
    reasons["crop_coefficient"] += "; applies only if evapotranspiration is computed"
    if fit.site.z_veg != target:
        reasons["z_veg"] = "choose your own"
    site = read_site(file, {name: float(f"{getattr(fit.site, name):.6g}") for name in reasons})
    lines = (f"# {line}" for each in heading for line in textwrap.wrap(each, 98))
    return "\n".join([*lines, "", format_site(site, reasons)])


def describe_scores(row: FitScores) -> str:
    """Return the scores of a quantity in one half as a sentence."""
    nse = ", ".join(f"{value:.2f} ({duration(span_s)})" for span_s, value in row.nse.items())
    return (
        f"The {row.quantity} in the {row.part} period has an NSE of {nse}, and its volume is "
        f"{100 * row.volume_error:+.1f} % off."
    )


def _list_notes(
    record: StepRecord, halves: Mapping[str, Steps], before: Site, fitted: Site
) -> list[str]:
    spans = [np.flatnonzero(steps) for steps in halves.values()]
    days = sum(map(len, spans)) * record.step_s / DAY_S
    fit, validation = (f"{record.time(span[0])} to {record.time(span[-1])}" for span in spans)
    notes = [
        f"compared: {days:.3g} days; fit {fit}, validation {validation}. The other days have gaps, "
        "are in months that are not used, or follow a time in which a storm may have gone "
        "unrecorded"
    ]
    if "runoff" in record.measured:
        known = record.complete
        came, gone = record.water[known].sum(), record.measured["runoff"][known].sum()
        notes.append(
            f"balance: of {came:.4g} mm of rain and pumped water, {gone:.4g} mm ran off "
            f"({gone / came:.0%}); if that cannot be, check the units, the clocks and the sensors"
        )
    if fitted.z_veg != before.z_veg:
        notes.append(
            f"target: the fitted roof cannot hold z_veg = {before.z_veg:g} m; z_veg is set to "
            f"{fitted.z_veg:g} m, where half of the plant-available water is left (FAO-56, chapter "
            "8); choose your own target"
        )
    return notes
