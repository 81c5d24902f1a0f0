"""The site file of a fitted roof: the file that the fit began with, with fitted values."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ruamel.yaml.comments import CommentedMap

from greenroof_ros.analysis.calibration.fit import FILLED, Fit
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.pump_curve import PumpCurve
from greenroof_ros.model.site import edit_site_text, read_site, site_parameters, site_yaml

CROP_NOTE = (
    "applies only if evapotranspiration is computed (fao56; hargreaves in calibrate), not if a "
    "weather file has it"
)
"""Where a crop coefficient has an effect."""
INTERVAL_NOTE = (
    "The intervals include the effect of parameters that the record cannot distinguish, anywhere "
    "in their ranges. All other parameters have the site file's values."
)
"""What the intervals of fitted parameters cover."""

_COMMENT = 30
_UNITS = {parameter.name: parameter.unit for parameter in site_parameters()}
_FROM_SHEET = "fitted to points of the data sheet"
# Written in this order if the file has none of them.
_ROOF = (
    "field_capacity", "wilting_point", "depletion_fraction", "drainage_storage", "drainage_time",
    "crop_coefficient",
)


Entries = dict[str, tuple[float, str]]
"""entries for a site file: by name a value, and the words that follow its unit"""


def list_sheet_entries(sheet: PumpCurve) -> Entries:
    """Return the entries of a pump curve that was fitted to a data sheet."""
    return {name: (value, _FROM_SHEET) for name, value in sheet._asdict().items()}


def list_fit_entries(fit: Fit, target: float, sheet: PumpCurve | None) -> Entries:
    """Return the entries of a fit: each with its interval, or why the record does not identify it.

    Args:
        fit: the result, with the pumps' parameters if the record has data on them.
        target: target depth on the roof (m) in the original site file.
        sheet: pump curve that was fitted to the data sheet before.
    """
    entries: Entries = {name: (getattr(fit.site, name), "unchanged, not fitted") for name in _ROOF}
    entries |= {} if sheet is None else list_sheet_entries(sheet)
    for parameter in fit.parameters:
        reason = f"unchanged: {parameter.reason}"
        if parameter.interval:
            interval = f"fitted, {parameter.interval} (95 %)"
            reason = f"{interval}; {parameter.reason}" if parameter.reason else interval
        elif parameter.name in entries and parameter.name not in _ROOF:
            reason = f"{_FROM_SHEET}; {parameter.reason}"
        if parameter.name == "crop_coefficient":
            reason += f"; {CROP_NOTE}"
        if parameter.name != FILLED:
            entries[parameter.name] = parameter.value, reason
    if fit.site.z_veg != target:
        entries["z_veg"] = fit.site.z_veg, "choose your own"
    return entries


def edit_site_file(file: Path, entries: Entries, heading: Sequence[str]) -> str:
    """Return the text of a site file with some entries replaced.

    Entries of a file that it extends are copied into it, so that it needs no other file.

    Args:
        file: the site file.
        entries: by name; an entry that is not in the file is appended.
        heading: lines for the top.

    Raises:
        ConfigurationError: the result is not a valid site, because a value is out of its range.
    """
    yaml = site_yaml()
    values = {name: f"{value:.6g}" for name, (value, _) in entries.items()}
    missing = [name for name in entries if name not in yaml.load(edit_site_text(file, {}))]
    fitted = {key: float(text) for key, text in values.items()}
    site: CommentedMap = yaml.load(edit_site_text(file, fitted))
    site.fa.set_block_style()
    for name, (_, reason) in entries.items():
        site[name] = values[name]
        _write_comment(site, name, f"# {_UNITS[name]:<7} {reason}")
    if missing:
        site.yaml_set_comment_before_after_key(missing[0], before="\nThe measured soil")
    stream = io.StringIO()
    yaml.dump(site, stream)
    text = "\n".join([*(f"# {line}" for line in heading), "", stream.getvalue()])
    with TemporaryDirectory() as directory:
        written = Path(directory) / "site.yaml"
        written.write_text(text, encoding="utf-8")
        try:
            read_site(written)
        except ConfigurationError as error:
            raise ConfigurationError(
                f"the fitted values do not make a valid site; nothing is written: {error.wrong}",
                file=file,
            ) from error
    return text


def _write_comment(site: CommentedMap, name: str, text: str) -> None:
    """Replace the comment after an entry, and keep comments on the lines below.

    The YAML reader stores all comments up to the next entry together. Indented lines continue the
    comment after the entry, and are replaced with it.
    """
    token: Any = site.ca.items.get(name, [None] * 4)[2]
    below = token.value.partition("\n")[2].splitlines(keepends=True) if token else []
    while below and below[0].lstrip() != below[0] and below[0].strip():
        below.pop(0)
    site.yaml_add_eol_comment(text, name, column=_COMMENT)
    site.ca.items[name][2].value = "".join([f"{text}\n", *below])
