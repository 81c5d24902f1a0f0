"""The page of a calibration: one file that needs nothing but a browser."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from greenroof_ros.calibration.fit import FILLED, Fit
from greenroof_ros.calibration.record import Record
from greenroof_ros.calibration.scores import ScoreRow, time_name
from greenroof_ros.calibration.site_file import CROP_NOTE, INTERVAL_NOTE
from greenroof_ros.common.versions import versions, versions_text
from greenroof_ros.model.site import site_parameters
from greenroof_ros.report.drawing import Figure
from greenroof_ros.report.page import library, payload
from greenroof_ros.report.templates import environment


class _ParameterRow(NamedTuple):
    name: str
    unit: str
    value: str
    interval: str
    words: str
    meaning: str


def render(
    record: Record, fit: Fit, scores: Sequence[ScoreRow], figures: Sequence[Figure],
    site_file: str, spans: Mapping[str, str], notes: Sequence[str], warning: str,
) -> str:
    """Return the page.

    Args:
        record: what was measured in the months that count.
        fit: the result.
        scores: of each quantity, in the fit and in the validation.
        figures: in the order in which they appear.
        site_file: that was written.
        spans: from when to when each part is.
        notes: what was found beside the roof's parameters.
        warning: what speaks against the fit; empty where nothing does.
    """
    sites = {one.name: one for one in site_parameters()}
    parameters = [
        _ParameterRow(
            one.name,
            "1" if one.name == FILLED else sites[one.name].unit,
            f"{one.value:.4g}",
            f"{one.low:.4g} to {one.high:.4g}" if one.told else "",
            one.words,
            "share of the available water on the roof when the record begins"
            if one.name == FILLED else sites[one.name].meaning,
        )
        for one in fit.parameters
    ]
    return environment(__package__).get_template("page.html").render(
        source=str(record.source), parameters=parameters, scores=scores, figures=figures,
        times=list(scores[0].scores.nse), time_name=time_name, shown=_shown, site_file=site_file,
        spans=spans, notes=notes, crop_note=CROP_NOTE,
        interval_note=INTERVAL_NOTE, warning=warning,
        rain=f"{float(np.nansum(record.rain)):.4g}",
        step=time_name(round(record.step_s)), versions=versions_text(versions()),
        library=library(), payload=payload(figures),
    )


def _shown(value: float, form: str) -> str:
    return "-" if np.isnan(value) else format(value, form)
