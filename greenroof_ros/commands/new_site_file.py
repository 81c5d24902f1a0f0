"""Generation of the text of a site file for a house about which little is known.

The file marks the given values, and states the source of every assumption, so that readers can
correct the assumptions.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

from greenroof_ros.base.files import default_site_file
from greenroof_ros.physics.cistern import EMPTIED_H, find_outlet_radius
from greenroof_ros.site.clock import standard_offset
from greenroof_ros.site.file import LITRES_PER_HOUR, SITE_KEYS, SUBSTRATES, read_site
from greenroof_ros.site.site import Site

HEIGHT, RUNOFF, SUBSTRATE, RATE, LIFT = 2.0, 0.9, "neubrandenburg", 3.0, 6.0
"""assumed: height of the cistern (m), runoff coefficient of the catchment (1), substrate,
irrigation rate (mm/h) and height of the roof (m)"""

_FLOWS = ("pump_flow", "irrigation_rate", "emitters")
# Evapotranspiration of reference grass on a July day in Toronto (m), and the plants' ratio to it.
_DAY, _CROP = 0.004, 0.96
# The target is at most this share of the water that the substrate holds.
_MAX_FILLED = 0.95

# Levels in the cistern (m) and minimum flow from the mains (m3/s), from config/site_valve.yaml.
_SUCTION, _MAINS_LEVEL, _VALVE_LEVEL, _MAINS_FLOW = 0.05, 0.07, 0.1, 2e-4
# Column at which comments begin, and width of the page (characters).
_COLUMN, _WIDTH = 30, 120


def format_new_site(
    given: Mapping[str, Any], *, valve: bool = False, mains: bool = True
) -> str:
    """Return the text of a site file.

    Args:
        given: given values, by their keys in a site file. ``roof_area``, ``catchment_area``,
            ``cistern_volume``, ``latitude`` and ``longitude`` are required; other values replace
            assumptions.
        valve: whether the cistern has a low outlet with a valve.
        mains: whether mains water is added when the cistern is nearly empty.
    """
    parts = (
        _head(given), _place(given), _cistern(given, valve=valve, mains=mains), _roof(given),
        _pump(given), _run(given),
    )
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def _line(
    given: Mapping[str, Any], key: str, assumed: Any, meaning: str, source: str = "[assumed]",
    *, active: bool = True,
) -> Iterator[str]:
    """Yield the lines for a key: its value, its unit, and a comment with the value's source.

    Args:
        given: given values by key, which are always written as active lines.
        key: the key.
        assumed: value that is assumed if no value is given for the key.
        meaning: explanation of the value.
        source: source of the assumed value.
        active: whether an assumed value applies to the site; otherwise the line is commented out.
    """
    value, source = (given[key], "[given]") if key in given else (assumed, source)
    if isinstance(value, float):
        value = f"{value:.6g}" if value % 1 else f"{value:.1f}"
    mark = "" if active or key in given else "# "
    comment = _wrap(f"{meaning} {source}".strip(), _WIDTH - _COLUMN - 10)
    first, *further = comment
    yield f"{mark + f'{key}: {value}':<{_COLUMN - 1}} # {_unit(key):<7} {first}".rstrip()
    for text in further:
        yield f"{'#':>{_COLUMN + 1}}{'':9}{text}"


def _unit(key: str) -> str:
    unit = SITE_KEYS[key].unit if key in SITE_KEYS else ""
    return {"degrees": "deg"}.get(unit, unit)


def _wrap(text: str, width: int) -> list[str]:
    return textwrap.wrap(text, width, break_on_hyphens=False, break_long_words=False)


def _head(given: Mapping[str, Any]) -> Iterator[str]:
    text = (
        f"Site file of a green roof of {given['roof_area']:g} m2 and its cistern, written by "
        "'greenroof new-site'. The source of every value is in brackets: [given] in an answer, "
        "[assumed], or the name of a publication or file. Replace values for which you have "
        "better information; doc/reference/file-formats.md lists all keys."
    )
    yield from (f"# {line}" for line in _wrap(text, _WIDTH - 2))
    yield ""
    yield from (
        "# The physical constants, the overflow and the pipe are those of the paper. The pipe "
        "affects only the pump's energy.",
        "extends: site.yaml",
    )


def _place(given: Mapping[str, Any]) -> Iterator[str]:
    yield "# Place"
    yield from _line(given, "latitude", None, "positive to the north")
    yield from _line(given, "longitude", None, "positive to the east")
    yield from _line(
        given, "elevation", 100.0, "above sea level; if omitted, derived from the mean "
        "pressure in the weather file", "", active=False,
    )
    zone = given.get("time_zone")
    offset = standard_offset(zone) if zone else float(round(given["longitude"] / 15))
    yield from _line(
        given, "time_zone", "Europe/Berlin", "for quiet_hours, and for weather files whose clock "
            "observes daylight saving time", "", active=False,
    )
    yield from _line(
        given, "utc_offset", offset, "local standard time; required for weather files whose times "
        "have no UTC offset", "[time_zone]" if zone else "", active=zone is not None,
    )
    yield (
        "# monthly_evapotranspiration: monthly means (mm/day), as printed by 'greenroof "
        "weather', for rain gauges and live sites"
    )


def _cistern(given: Mapping[str, Any], *, valve: bool, mains: bool) -> Iterator[str]:
    height = given.get("cistern_height", HEIGHT)
    base = given["cistern_volume"] / height
    yield "# Cistern (tank 1)"
    yield from _line(given, "cistern_volume", None, "volume up to the overflow")
    yield from _line(given, "cistern_height", HEIGHT, "level of the overflow")
    yield from _line(given, "catchment_area", None, "area of the roofs that drain to the cistern")
    yield from _line(
        given, "runoff_coefficient", RUNOFF,
        "share of the rain on these roofs that reaches the cistern",
        "[0.75 to 0.95 for roofs, ASCE]",
    )
    like_valve = "[assumed, as in site_valve.yaml]"
    yield from _line(
        given, "z_pump", 0.0, "elevation of the pump above the cistern's base", like_valve
    )
    yield from _line(
        given, "z_H", _SUCTION, "minimum depth of water that the pump needs", like_valve
    )
    if not mains:
        yield "# No mains supply [given]. To add one:"
    yield from _line(
        given, "mains_level", _MAINS_LEVEL, "level below which a float valve adds mains water",
        like_valve, active=mains,
    )
    flow = max(_MAINS_FLOW, float(f"{1.2 * _find_flow(given):.2g}"))
    yield from _line(
        given, "mains_flow", flow, f"flow of the float valve, {3600 * flow:.2g} m3/h, which "
        "exceeds the flow of the pump", active=mains,
    )
    if not valve:
        yield (
            "# No low outlet [assumed]. To empty the cistern before rain, add a low outlet with a "
            "valve:"
        )
    yield from _outlet(
        _VALVE_LEVEL, base, height, f"the open valve empties a full cistern in {EMPTIED_H:g} h",
        given, active=valve,
    )
    yield from _line(
        given, "low_outlet_valve", "true", "a policy opens and closes the valve", "", active=valve
    )
    if not valve:
        yield "# Or add an orifice that is always open, without low_outlet_valve:"
        yield from _outlet(
            height / 2, base, height,
            f"the orifice empties the upper half of the cistern in {EMPTIED_H:g} h", given,
            active=False,
        )


def _outlet(
    level: float, base: float, height: float, meaning: str, given: Mapping[str, Any], *,
    active: bool,
) -> Iterator[str]:
    """Yield the lines for a low outlet that drains the cistern to the outlet's level in 12 h.

    Args:
        level: level of the outlet (m).
        base: area of the cistern's base (m2).
        height: level of the overflow (m).
        meaning: text of the comment on the radius.
        given: given values, by key.
        active: whether the outlet applies to the site; otherwise its lines are commented out.
    """
    radius = find_outlet_radius(_paper(), base, max(0.0, height - level), 3600 * EMPTIED_H)
    yield from _line(given, "low_outlet_level", level, "level of the low outlet", active=active)
    yield from _line(
        given, "low_outlet_radius", max(0.001, float(f"{radius:.2g}")),
        f"{meaning}, from Eq. (2)", active=active,
    )


def _paper() -> Site:
    return read_site(default_site_file())


def _roof(given: Mapping[str, Any]) -> Iterator[str]:
    substrate = SUBSTRATES[given.get("substrate", SUBSTRATE)]
    yield "# Roof (tank 2)"
    yield from _line(given, "roof_area", None, "green roof")
    yield from _line(
        given, "substrate", SUBSTRATE,
        f"one of {', '.join(SUBSTRATES)}. About this substrate: {substrate['about']}",
    )
    yield from _line(
        given, "substrate_depth", substrate["depth"],
        "0.06 to 0.15 for sedum and herbs, deeper for shrubs", "[depth in the substrate's source]",
    )
    yield from _line(
        given, "crop_coefficient", _CROP,
        "ratio of the plants' evapotranspiration to that of the reference grass",
        "[fit, site_neubrandenburg.yaml]",
    )
    target, how = find_target(given)
    yield from _line(given, "z_veg", target, "target level of water in the substrate", f"[{how}]")


def find_target(given: Mapping[str, Any]) -> tuple[float, str]:
    """Return the target level of water on the roof (m), and an explanation of how it was derived.

    The target is the level at which water stress begins plus the demand of a summer day, as
    recommended in doc/howto/choose-target-and-controller.md, but always less than the water that
    the substrate can hold.
    """
    substrate = SUBSTRATES[given.get("substrate", SUBSTRATE)]
    depth = given.get("substrate_depth", substrate["depth"])
    capacity, wilting = substrate["field_capacity"], substrate["wilting_point"]
    onset = depth * (wilting + (1 - substrate["depletion_fraction"]) * (capacity - wilting))
    target = min(onset + _DAY * _CROP, _MAX_FILLED * depth * capacity)
    return math.floor(1e4 * target) / 1e4, (
        f"the level at which plants begin to lack water, {1000 * onset:.1f} mm, plus the demand "
        f"of a summer day, {1000 * _DAY * _CROP:.1f} mm, but at most {_MAX_FILLED:.0%} of the "
        "water that the substrate can hold"
    )


def _find_flow(given: Mapping[str, Any]) -> float:
    """Return the pump's flow (m3/s)."""
    litres = given.get("pump_flow") or given.get("emitters", 0) * given.get("emitter_flow", 0.0)
    litres = litres or given.get("irrigation_rate", RATE) * given["roof_area"]
    return float(litres * LITRES_PER_HOUR)


def _pump(given: Mapping[str, Any]) -> Iterator[str]:
    litres = f"{_find_flow(given) / LITRES_PER_HOUR:.3g} l/h"
    yield "# Pump with a constant flow. Alternative keys: pump_flow, or emitters and emitter_flow"
    for key in (*_FLOWS, "emitter_flow"):
        if key in given:
            yield from _line(
                given, key, None, litres if key != "emitter_flow" else "flow of each emitter"
            )
    if not any(key in given for key in _FLOWS):
        yield from _line(
            given, "irrigation_rate", RATE, f"{litres} on this roof",
            "[assumed; drip lines: 2 to 4]",
        )
    yield from _line(
        given, "d", LIFT, "height of the roof above the cistern's base; this affects only the "
            "pump's energy",
    )
    yield (
        '# quiet_hours: ["22:00-06:00"]  # times at which the pump stays off, in time_zone; '
        "none [assumed]"
    )


def _run(given: Mapping[str, Any]) -> Iterator[str]:
    target = given.get("z_veg", find_target(given)[0])
    yield "# Runs start with the cistern half full and the roof at its target; if you change"
    yield "# cistern_volume, roof_area or z_veg, also change these two volumes"
    yield from _line(given, "initial_cistern", given["cistern_volume"] / 2, "", )
    yield from _line(
        given, "initial_roof", float(f"{target * given['roof_area']:.6g}"), "roof_area times z_veg"
    )
    yield from _line(
        given, "tau", 60.0, "duration of a tick; short enough for such a small pump, but a live "
        "site requires 1 s"
    )
    yield from _line(given, "N", 720, "number of ticks in a run without --hours, here 12 h")
