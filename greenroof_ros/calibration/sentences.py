"""What a calibration found beside the roof's parameters, in words: output, page, site file."""

from __future__ import annotations

from greenroof_ros.calibration.dry_nights import LevelSensor
from greenroof_ros.calibration.months import Months
from greenroof_ros.calibration.pump import PumpFit
from greenroof_ros.model.pump_curve import PumpCurve
from greenroof_ros.model.site import Site


def of_months(months: Months) -> str:
    """Say which months count."""
    return f"months: {months.text} are fitted and judged; the others are simulated only"


def of_sheet(sheet: PumpCurve) -> str:
    """Say which curve was fitted to the pumps' data sheet."""
    return f"data sheet: a_hat {sheet.a_hat:.6g} s2/m5, c_hat {sheet.c_hat:.6g} m"


def of_sensor(sensor: LevelSensor | None) -> str:
    """Say what the dry nights tell about the level sensor."""
    if sensor is None:
        return (
            "level sensor: fewer than five dry nights are seen in the record, so nothing is said "
            "of its noise and drift"
        )
    drift, half = (30 * 1000 * value for value in (sensor.drift, sensor.half))
    text = (
        f"level sensor: noise {1000 * sensor.noise:.2g} mm and drift {drift:+.2g} mm a month, "
        f"{half:.2g} mm either way (95 %), in {sensor.nights} dry nights"
    )
    return f"{text}: no drift that can be told" if abs(drift) <= half else text


def of_target(site: Site, fitted: Site) -> str:
    """Say which target stands in place of one that the fitted roof cannot hold."""
    return (
        f"target: z_veg was {site.z_veg:g} m, and the fitted roof holds "
        f"{fitted.roof_level(fitted.z_cap):.3g} m; it is set to {fitted.z_veg:g} m, where half of "
        "what plants can take is left (FAO-56, chapter 8): choose your own"
    )


def of_pump(pump: PumpFit | None) -> str:
    """Say what the cistern's fall tells about the pumps."""
    if pump is None:
        return (
            "pumps: fewer than ten runs in which nothing else moves the cistern, so nothing is "
            "said of their flow"
        )
    text = (
        f"pumps: {1000 * pump.flow:.3g} l/s at full command, {1000 * pump.half:.2g} l/s either way "
        f"(95 %), with {pump.level:.2f} m in the cistern; from {pump.runs} runs without rain"
    )
    if pump.left_out:
        text += f"; {pump.left_out} more, in which something else moved the cistern, do not count"
    return ". ".join([text, *pump.words])
