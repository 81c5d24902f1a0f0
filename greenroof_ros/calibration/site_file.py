"""The site file of a fitted roof: the one that the fit began with, and what was fitted in it."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from ruamel.yaml.comments import CommentedMap

from greenroof_ros.calibration.fit import FILLED, Fit, Parameter
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.pump_curve import PumpCurve
from greenroof_ros.model.site import edited, read_site, site_parameters, site_yaml

CROP_NOTE = (
    "counts where evapotranspiration is computed (fao56; hargreaves in calibrate), not with a "
    "weather file's own column"
)
"""What a crop coefficient does in a run."""
INTERVAL_NOTE = (
    "The intervals allow for what the record cannot tell apart, wherever it lies in its range. All "
    "else is taken to be as the site file has it."
)
"""What the interval of a fitted parameter leaves out."""

_COMMENT = 30
_UNITS = {one.name: one.unit for one in site_parameters()}
_FROM_SHEET = "fitted to points of the data sheet"
# Written in this order where the file has none of them.
_ROOF = (
    "field_capacity", "wilting_point", "depletion_fraction", "drainage_storage", "drainage_time",
    "crop_coefficient",
)
# What follows from the roof, as read_site computes it.
_PRODUCTS = {"x2_star": ("a2", "z_veg"), "z_cap": ("a2", "z_soil", "field_capacity")}


class Entry(NamedTuple):
    """What is to stand in a site file: a value, and the words behind its unit."""

    value: float
    words: str


def sheet_entries(sheet: PumpCurve) -> dict[str, Entry]:
    """Return the entries of a curve that was fitted to a data sheet."""
    return {name: Entry(value, _FROM_SHEET) for name, value in sheet._asdict().items()}


def fit_entries(fit: Fit, target: float, sheet: PumpCurve | None) -> dict[str, Entry]:
    """Return the entries of a fit: each with its interval, or why the record cannot tell it.

    Args:
        fit: the result, with the pumps' parameters if the record tells something of them.
        target: depth on the roof (m) that the site file had.
        sheet: what was fitted to the pumps' data sheet before.
    """
    told = {one.name: one for one in fit.parameters if one.name != FILLED}
    entries = {} if sheet is None else sheet_entries(sheet)
    for name in _ROOF:
        words = _words(told[name]) if name in told else "as it was, not fitted"
        if name == "crop_coefficient":
            words += f"; {CROP_NOTE}"
        entries[name] = Entry(getattr(fit.site, name), words)
    if fit.site.z_veg != target:
        entries["z_veg"] = Entry(fit.site.z_veg, "choose your own")
    for name in told.keys() - set(_ROOF):
        one = told[name]
        words = _words(one)
        if sheet is not None and not one.told:
            words = f"{_FROM_SHEET}; {one.words}"
        entries[name] = Entry(one.value, words)
    return entries


def _words(one: Parameter) -> str:
    if not one.told:
        return f"as it was: {one.words}"
    interval = f"fitted, {one.low:.4g} to {one.high:.4g} (95 %)"
    return f"{interval}; {one.words}" if one.words else interval


def edited_site_file(file: Path, entries: Mapping[str, Entry], heading: Sequence[str]) -> str:
    """Return the text of a site file with other entries; all else in it stays as it is.

    What it has from a file that it extends is put into it, so that it stands by itself.

    Args:
        file: with the site.
        entries: by name; an entry that the file does not have comes last.
        heading: lines for the top.

    Raises:
        ConfigurationError: the text would be no site, since a value is out of its range.
    """
    yaml = site_yaml()
    site: CommentedMap = yaml.load(edited(file, {}))
    site.fa.set_block_style()
    missing = [name for name in entries if name not in site]
    for name, entry in entries.items():
        site[name] = f"{entry.value:.6g}"
        _comment(site, name, f"# {_UNITS[name]:<7} {entry.words}")
    if missing:
        site.yaml_set_comment_before_after_key(missing[0], before="\nThe measured roof")
    for name, factors in _PRODUCTS.items():
        if name in site and not entries.keys().isdisjoint(factors):
            product = 1.0
            for factor in factors:
                product *= float(site.get(factor, 1.0))
            site[name] = repr(product)
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
                f"with what was fitted it is no site, and nothing is written: {error.wrong}",
                file=file,
            ) from error
    return text


def _comment(site: CommentedMap, name: str, text: str) -> None:
    """Replace the comment behind an entry; what is on lines of their own below stays.

    The reader keeps all comments up to the next entry with the one before it. Those that are
    indented go on with the comment that is replaced.
    """
    token: Any = site.ca.items.get(name, [None] * 4)[2]
    below = token.value.partition("\n")[2].splitlines(keepends=True) if token else []
    while below and below[0].lstrip() != below[0] and below[0].strip():
        below.pop(0)
    site.yaml_add_eol_comment(text, name, column=_COMMENT)
    site.ca.items[name][2].value = "".join([f"{text}\n", *below])
