"""A calibration: the fit of a site's roof to a record, its scores, and the new site file."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from greenroof_ros.analysis.calibration.bag_record import read_bag_record
from greenroof_ros.analysis.calibration.checks import check_fit, check_record
from greenroof_ros.analysis.calibration.csv_record import read_csv_record
from greenroof_ros.analysis.calibration.fit import (
    FILLED,
    Fit,
    UpdateProgress,
    complete_roof,
    lower_target,
)
from greenroof_ros.analysis.calibration.percolation import (
    EXPONENT,
    EXPONENTS,
    choose_exponent,
    fit_exponents,
)
from greenroof_ros.analysis.calibration.record import halve_steps, select_comparable, select_months
from greenroof_ros.analysis.calibration.scores import FitScores, score
from greenroof_ros.analysis.calibration.step_record import DAY_S, StepRecord, Steps, name_time
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.site.file import format_site, read_site
from greenroof_ros.site.site import Site

CROP_NOTE = (
    "applies only if evapotranspiration is computed (fao56; hargreaves in calibrate), not if a "
    "weather file contains it"
)
"""where a crop coefficient has an effect"""
INTERVAL_NOTE = (
    "The intervals include the effect of parameters that the record cannot identify and that may "
    "have any value within their ranges. All other parameters have the values from the original "
    "site file."
)
"""what the intervals of fitted parameters cover"""

_ROOF = (
    "field_capacity", "wilting_point", "depletion_fraction", "drainage_storage", "drainage_time",
    "crop_coefficient",
)


Entries = dict[str, tuple[float, str]]
"""entries for a site file: by name a value, and the words that follow its unit"""


def list_fit_entries(fit: Fit, target: float) -> Entries:
    """Return the entries of a fit, each with its interval, or the reason why it is not identified.

    Args:
        fit: result of the fit.
        target: target depth on the roof (m) in the original site file.
    """
    entries: Entries = {name: (getattr(fit.site, name), "unchanged, not fitted") for name in _ROOF}
    for parameter in fit.parameters:
        reason = f"unchanged: {parameter.reason}"
        if parameter.interval:
            interval = f"fitted, {parameter.interval}"
            if parameter.name != EXPONENT:
                interval += " (95 %)"
            reason = f"{interval}; {parameter.reason}" if parameter.reason else interval
        if parameter.name == "crop_coefficient":
            reason += f"; {CROP_NOTE}"
        if parameter.name != FILLED:
            entries[parameter.name] = parameter.value, reason
    if fit.site.z_veg != target:
        entries["z_veg"] = fit.site.z_veg, "choose your own"
    return entries


def format_fitted_site(file: Path, entries: Entries, heading: Sequence[str]) -> str:
    """Return the text of a complete site file with fitted values.

    Args:
        file: path of the original site file.
        entries: entries of the fit.
        heading: comment lines for the top of the file.

    Raises:
        ConfigurationError: if the result is not a valid site, because a value is out of range.
    """
    fitted = {name: float(f"{value:.6g}") for name, (value, _) in entries.items()}
    try:
        site = read_site(file, fitted)
    except ConfigurationError as error:
        raise ConfigurationError(
            f"the fitted values do not form a valid site, so no file was written: {error.wrong}",
            file=file,
        ) from error
    text = format_site(site, {name: reason for name, (_, reason) in entries.items()})
    return "\n".join([*(f"# {line}" for line in heading), "", text])


@dataclass(frozen=True)
class Calibration:
    """A roof that was fitted to the first half of a record's rain, and validated on the second.

    Attributes:
        site: the fitted site.
        site_file: text of its site file.
        record: the measurements in the months that were used.
        halves: steps of the record that were fitted (``fit``) and validated (``validation``).
        fit: the parameters, and the record as simulated.
        scores: scores of every quantity in either half.
        warnings: what is wrong with the fit.
        notes: other findings for the reader.
    """

    site: Site
    site_file: str
    record: StepRecord
    halves: Mapping[str, Steps]
    fit: Fit
    scores: Sequence[FitScores]
    warnings: Sequence[str]
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
        ConfigurationError: if the record or the site is invalid, or if no roof fits the record.

    Example:
        >>> import greenroof_ros as gr
        >>> made = gr.calibrate("roof_2025.csv", "my_site.yaml")  # doctest: +SKIP
        >>> made.site.field_capacity, made.scores, made.warnings  # doctest: +SKIP
    """
    file, source = Path(site), Path(measured)
    start = complete_roof(read_site(file))
    is_bag = source.is_dir() or source.suffix.lower() == ".mcap"
    record = read_bag_record(source, start) if is_bag else read_csv_record(source, start, months)
    counts = select_months(record, months)
    counted = record.select(counts)
    check_record(counted)
    halves = halve_steps(record, select_comparable(record) & counts)
    _refuse_dry(record, halves)
    own = start.percolation_exponent
    fits = fit_exponents(start, record, halves, progress, sorted({*EXPONENTS, own}))
    fitted, of_exponents = choose_exponent(fits, own)
    fitted = fitted._replace(site=lower_target(fitted.site))
    scores = [
        score(
            name, part, getattr(fitted.simulated, name)[steps], series[steps],
            record.seconds[steps], record.step_s,
        )
        for name, series in record.measured.items() for part, steps in halves.items()
    ]
    warnings = check_fit(scores, source)
    notes = [*record.notes, *_list_notes(record, halves, start, fitted.site), of_exponents]
    entries = list_fit_entries(fitted, start.z_veg)
    heading = [
        f"Fitted to {source.name} by greenroof calibrate.", describe_halves(record, halves),
        *map(describe_scores, scores), INTERVAL_NOTE, *notes, *warnings,
    ]
    text = format_fitted_site(
        file, entries, [line for each in heading for line in textwrap.wrap(each, 98)]
    )
    return Calibration(fitted.site, text, counted, halves, fitted, scores, warnings, notes)


def describe_halves(record: StepRecord, halves: Mapping[str, Steps]) -> str:
    """Return the time spans of the fit and of the validation as a sentence."""
    spans = [
        " to ".join(record.time(int(step))[:16] for step in np.flatnonzero(steps)[[0, -1]])
        for steps in halves.values()
    ]
    return f"Fit: {spans[0]}; validation: {spans[1]}."


def describe_scores(row: FitScores) -> str:
    """Return the scores of a quantity in one half as a sentence."""
    nse = ", ".join(f"{value:.2f} ({name_time(span_s)})" for span_s, value in row.nse.items())
    span_s, kge = list(row.kge.items())[-1]
    volume = f"; volume {100 * row.volume_error:+.1f} %" if row.quantity == "runoff" else ""
    return f"{row.quantity}, {row.part}: NSE {nse}; KGE {kge:.2f} ({name_time(span_s)}){volume}."


def _list_notes(
    record: StepRecord, halves: Mapping[str, Steps], before: Site, fitted: Site
) -> list[str]:
    days = record.step_s / DAY_S
    compared = sum(int(np.count_nonzero(steps)) for steps in halves.values()) * days
    notes = [
        f"compared: {compared:.3g} of {record.steps * days:.3g} days; the other days have "
        "gaps, are in months that are not used, or follow a time in which a storm may have gone "
        "unrecorded"
    ]
    if record.runoff is not None:
        known = record.complete
        came, gone = float(record.water[known].sum()), float(record.runoff[known].sum())
        notes.append(
            f"balance: of {came:.4g} mm of rain and pumped water, {gone:.4g} mm ran off "
            f"({gone / came:.0%}); if that cannot be, check the units, the clocks and the sensors"
        )
    if fitted.z_veg != before.z_veg:
        notes.append(
            f"target: z_veg was {before.z_veg:g} m, and the fitted roof holds "
            f"{fitted.roof_level(fitted.z_cap):.3g} m; z_veg is set to {fitted.z_veg:g} m, where "
            "half of the plant-available water is left (FAO-56, chapter 8); choose your own target"
        )
    return notes


def _refuse_dry(record: StepRecord, halves: Mapping[str, Steps]) -> None:
    """Reject a record that contains nothing to fit, or nothing to validate the fit against."""
    for half, steps in zip(("first", "second"), halves.values(), strict=True):
        if not steps.any() or all(np.ptp(each[steps]) == 0 for each in record.measured.values()):
            raise ConfigurationError(
                f"in the {half} half of its rain, no measured quantity changes, but fit and "
                "validation both need changes in runoff or levels; leave out the dry rows at the "
                "end, or use a longer record with fewer gaps", file=record.source,
            )
