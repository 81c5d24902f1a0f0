"""What a user sets of the pump's logic: one table, with defaults for the site."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.model.plant import maximum_pump_flow
from greenroof_ros.model.site import Site
from greenroof_ros.model.soil import kept_share, water_to_fill

DAY_S = 86_400.0
_LEAST_FLOW = 0.2
# More than the reference evapotranspiration of any climate in FAO-56, Table 2 (m/day).
_GREATEST_EVAPOTRANSPIRATION = 0.010
# Room for a flow that is only estimated, in what a day may need.
_MARGIN = 1.5


def _least_flow(site: Site) -> float:
    """Return the least flow by default at the suction level (m3/s)."""
    return _LEAST_FLOW * maximum_pump_flow(site, site.cistern_volume(site.suction_level))


def _volume_per_day(site: Site) -> float:
    """Fill an empty roof to its target and replace a day's evapotranspiration, with the margin.

    Of a measured roof that is more: its soil keeps only a share of what is pumped.
    """
    evapotranspiration = _GREATEST_EVAPOTRANSPIRATION * site.crop_coefficient * site.a2
    replaced = evapotranspiration / kept_share(site, site.x2_star)
    return round(_MARGIN * (water_to_fill(site, site.x2_star) + replaced), 3)


def _run_per_day(site: Site) -> float:
    """Return the time in which the least flow delivers a day's greatest volume (s)."""
    return min(DAY_S, round(_volume_per_day(site) / _least_flow(site)) + 1.0)


def _run(site: Site) -> float:
    """Return the time in which the least flow fills an empty roof to its target (s)."""
    return min(DAY_S, round(water_to_fill(site, site.x2_star) / _least_flow(site)) + 1.0)


def _setting(
    default: float | Callable[[Site], float], unit: str, low: float, high: float, meaning: str
) -> Any:
    """Return the field of a setting; its default may follow from the site."""
    return field(metadata={"parameter": Parameter("", default, unit, low, high, meaning)})


@dataclass(frozen=True)
class PumpSettings:
    """The limits of a pump, and the thresholds of its checks.

    Unit, range, default and meaning of each stand beside it; :func:`pump_parameters` lists them,
    and :func:`settings_for` fills in what is not given.
    """

    least_speed: float = _setting(
        0.3, "1", 0.05, 1.0,
        "least speed of the drive, share of the rated one; its drive file's where that is larger",
    )
    least_flow: float = _setting(
        _LEAST_FLOW, "1", 0.01, 1.0,
        "least continuous flow of the pump, share of the maximum; below it there are pulses",
    )
    ramp: float = _setting(
        1.0, "1/s", 0.001, 10.0,
        "how fast the asked speed changes while the pump runs; the drive has a ramp of its own",
    )
    least_on: float = _setting(10.0, "s", 0.0, 3600.0, "how long the pump stays on, once it is")
    least_off: float = _setting(10.0, "s", 0.0, 3600.0, "how long the pump stays off, once it is")
    starts_per_hour: float = _setting(
        lambda site: site.starts_per_hour, "1/h", 1.0, 3600.0,
        "starts in any hour; by default the site's",
    )
    greatest_run: float = _setting(
        _run, "s", 1.0, DAY_S,
        "time on without a break; by default in which a fifth of the flow fills an empty roof",
    )
    greatest_run_per_day: float = _setting(
        _run_per_day, "s", 1.0, DAY_S,
        "time on in 24 h; by default in which a fifth of the flow delivers the day's volume",
    )
    greatest_volume_per_day: float = _setting(
        _volume_per_day, "m3", 1e-6, 1e9,
        "pumped in 24 h; by default 1.5 times an empty roof's filling and 10 mm for the plants",
    )
    suction_hysteresis: float = _setting(
        0.02, "m", 0.0, 10.0,
        "how far above the level of a dry-run cut the cistern must be before the pump runs again",
    )
    drive_ramp: float = _setting(
        30.0, "s", 0.0, 30.0,
        "the drive's own ramp, from rest to rated speed and back, the longer of both; no drive may "
        "have a longer one than by default",
    )
    follow_tolerance: float = _setting(
        0.1, "1", 0.01, 1.0,
        "how far the speed may be from the asked one, or from what the ramp has reached on the way "
        "there, share of the rated one; less than the least speed",
    )
    follow_time: float = _setting(
        12.0, "s", 0.1, 600.0, "how long it may be farther, before that is a fault"
    )
    averaging_time: float = _setting(
        60.0, "s", 1.0, 3600.0, "time over which the delivery check averages levels and volumes"
    )
    level_tolerance: float = _setting(
        0.006, "m", 1e-4, 1.0,
        "change of a mean level that the delivery check leaves unexplained; 13 times the noise of "
        "the mean of readings each second with 5 mm, and above what a sensor resolves",
    )
    level_offset: float = _setting(
        0.02, "m", 0.0, 1.0,
        "how far a level sensor may be from the truth, above or below, for good; so far above the "
        "suction level is the dry-run cut",
    )
    least_delivery: float = _setting(
        0.5, "1", 0.05, 0.95,
        "share of the pumped volume that must reach the roof; its inverse may leave the cistern",
    )
    greatest_loss: float = _setting(
        1.0, "mm/h", 0.01, 1000.0,
        "greatest evapotranspiration of an hour, and greatest drift of a level sensor",
    )

    def __post_init__(self) -> None:
        """Refuse what contradicts itself.

        Raises:
            ConfigurationError: a pump at its least speed would count as one that stands.
        """
        if self.follow_tolerance >= self.least_speed:
            raise ConfigurationError(
                f"must be less than least_speed, {self.least_speed:g}: a pump that stands would "
                "count as one that runs, and one that is told to stop and runs on as one that "
                "stands",
                key="follow_tolerance", value=self.follow_tolerance,
            )


def pump_parameters(site: Site) -> tuple[Parameter, ...]:
    """Return each setting as a parameter, with its default for a site."""
    parameters = []
    for each in fields(PumpSettings):
        one: Parameter = each.metadata["parameter"]
        default = one.default(site) if callable(one.default) else one.default
        parameters.append(replace(one, name=each.name, default=default))
    return tuple(parameters)


def settings_for(site: Site, **given: float) -> PumpSettings:
    """Return settings for a site: those given, and the default of every other."""
    return PumpSettings(**{one.name: one.default for one in pump_parameters(site)} | given)
