"""The site file of a fitted roof: the one it began with, its fitted lines replaced."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from tempfile import TemporaryDirectory

from greenroof_ros.calibration.fit import FILLED, Fit, Parameter
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_text, read_yaml
from greenroof_ros.model.pump_curve import PumpCurve
from greenroof_ros.model.site import Site, read_site, site_parameters

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
# Lines that are left away: what follows from the roof is computed.
_COMPUTED = {"x2_star": "", "z_cap": ""}


def fitted_site_file(
    text: str, site: Site, fit: Fit, heading: Sequence[str], sheet: PumpCurve | None = None
) -> str:
    """Return the text of a site file with the fitted roof in it, and its pumps where they were.

    Each line of the roof has its value, its unit, and the interval of the fit or why the record
    cannot tell it; every other line stays as it is.

    Args:
        text: of the site file that the fit began with.
        site: that it is of.
        fit: its result, with the pumps' parameters if the record tells something of them.
        heading: lines about the record and the scores, for the top.
        sheet: what was fitted to the pumps' data sheet before.
    """
    told = {one.name: one for one in fit.parameters}
    lines = _COMPUTED | _roof_lines(fit) | ({} if sheet is None else _sheet_lines(sheet))
    if fit.site.z_veg != site.z_veg:
        lines["z_veg"] = _line("z_veg", f"{fit.site.z_veg:.6g}", "choose your own")
    for name in PumpCurve._fields:
        if name in told:
            comment = _comment(told[name])
            if sheet is not None and not told[name].told:
                comment = f"{_FROM_SHEET}; {told[name].words}"
            lines[name] = _line(name, f"{told[name].value:.6g}", comment)
    return _replaced(text, lines, heading)


def pump_site_file(text: str, sheet: PumpCurve, heading: Sequence[str]) -> str:
    """Return the text of a site file with the pump curve of a data sheet in it, no more.

    Args:
        text: of the site file.
        sheet: the curve.
        heading: lines for the top.
    """
    return _replaced(text, _sheet_lines(sheet), heading)


def refuse_other_forms(file: Path) -> None:
    """Refuse a site file whose lines cannot be replaced: each must be ``key: value``.

    YAML lets keys be in quotes, and all of them be in one line; their old values would stay.

    Raises:
        ConfigurationError: it has such a line.
    """
    lines = read_text(file).splitlines()
    for key, line in read_yaml(file).lines.items():
        if not re.match(rf"{key}\s*:", lines[line - 1]):
            raise ConfigurationError(
                f"the site file must have one 'key: value' a line, as in '{key}: 1.0'", file=file,
                line=line, key=key,
            )


def refuse_unlike(text: str, site: Site, file: Path) -> None:
    """Refuse the text of a site file that cannot be read, or is not the site that was fitted.

    Args:
        text: that is to be written.
        site: that it should be, but for the last of its six digits.
        file: the site file that the fit began with, which is to be changed then.

    Raises:
        ConfigurationError: it is so.
    """
    with TemporaryDirectory() as directory:
        written = Path(directory) / "site.yaml"
        written.write_text(text, encoding="utf-8")
        try:
            read = read_site(written)
        except ConfigurationError as error:
            raise ConfigurationError(
                f"with what was fitted it is no site, and nothing is written: {error.wrong}",
                file=file,
            ) from error
    for name in (field.name for field in fields(Site)):
        value, fitted = getattr(read, name), getattr(site, name)
        same = value == fitted or (
            None not in (value, fitted) and math.isclose(value, fitted, rel_tol=1e-5, abs_tol=1e-9)
        )
        if not same:
            raise ConfigurationError(
                "the site file must have one 'key: value' a line: this would stay, and "
                f"{fitted:.6g} was fitted", file=file, key=name, value=value,
            )


def _replaced(text: str, lines: Mapping[str, str], heading: Sequence[str]) -> str:
    """Put lines in the places of those of the same keys, with the comments that go on below."""
    kept: list[str] = []
    written: set[str] = set()
    continued = False
    for line in text.splitlines():
        key = re.match(r"(\w+)\s*:", line)
        if key and key[1] in lines:
            kept += [lines[key[1]]] if lines[key[1]] else []
            written.add(key[1])
            continued = True
        elif not (continued and re.match(r"\s+#", line)):
            kept.append(line)
            continued = False
    missing = [name for name in _ROOF if name in lines and name not in written]
    if missing:
        kept += ["", "# The measured roof", *(lines[name] for name in missing)]
    return "\n".join([*(f"# {line}" for line in heading), "", *kept]) + "\n"


def _sheet_lines(sheet: PumpCurve) -> dict[str, str]:
    """Return the lines of a curve that was fitted to a data sheet."""
    return {
        name: _line(name, f"{value:.6g}", _FROM_SHEET) for name, value in sheet._asdict().items()
    }


def _roof_lines(fit: Fit) -> dict[str, str]:
    """Return the line of each parameter of the roof."""
    told = {one.name: one for one in fit.parameters if one.name != FILLED}
    lines = {}
    for name in _ROOF:
        comment = _comment(told[name]) if name in told else "as it was, not fitted"
        if name == "crop_coefficient":
            comment += f"; {CROP_NOTE}"
        lines[name] = _line(name, f"{getattr(fit.site, name):.6g}", comment)
    return lines


def _line(name: str, number: str, comment: str) -> str:
    return f"{f'{name}: {number}':<{_COMMENT}}# {_UNITS[name]:<7} {comment}"


def _comment(one: Parameter) -> str:
    if not one.told:
        return f"as it was: {one.words}"
    interval = f"fitted, {one.low:.4g} to {one.high:.4g} (95 %)"
    return f"{interval}; {one.words}" if one.words else interval
