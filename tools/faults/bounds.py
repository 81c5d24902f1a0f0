"""How long the pump may run after a fault: the documented times, from the code's defaults.

doc/reference/interlocks.md and doc/reference/live-nodes.md give the same figures.
"""

from __future__ import annotations

import os

from greenroof_ros.live.devices.drive import DriveEndpoint
from greenroof_ros.live.devices.drive_file import LIMIT_S as OBEYS_S
from greenroof_ros.live.devices.exchange import FIRST_WAIT_S
from greenroof_ros.live.devices.relay import RelayEndpoint
from greenroof_ros.live.live_input import LIMITS
from greenroof_ros.live.pump import parameters as parameters_of_pump
from greenroof_ros.live.pumping.delivery import AVERAGING_S, MIN_DELIVERY
from greenroof_ros.live.pumping.pump_control import AFTERFLOW_S
from greenroof_ros.live.recorder import FLUSH_S
from greenroof_ros.physics.cistern import low_outlet_flow
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.pump import flow_at
from greenroof_ros.site.site import Site

# The simulated drive of the campaign: time from rated speed to rest, and its own timeout (s).
RAMP_S = 1.0
DRIVE_TIMEOUT_S = 5.0
# Limit of a run or of a day in cases about these limits, in place of the default (s).
LIMIT_S = 20.0
# The simulated valve of the campaign: time from open to closed, and the longest according to the
# site file (s); flow of its leak (m3/s); and the tolerance of the water balance (m).
TRAVEL_S, LONGEST_TRAVEL_S = 1.0, 6.0
LEAK, LEAK_TOLERANCE_M = 1e-3, 2e-3
# Time between two readings of a sensor at a site with a valve (s), and its averaging time (s).
SENSOR_S, VALVE_AVERAGING_S = 1.0, 60.0
# How long an open valve must have drained before it is judged by the level (s).
DRAINS_FOR_S = 600.0
# Time for which a person opens the valve (s).
BY_HAND_S = 5.0
# What the valve releases at most in a day, in a case about this limit (m3).
RELEASED_M3 = 0.04
# Moves of the valve in an hour, in cases about this limit.
MOVES = 240.0
# Added by a busy machine, and by the measurement, to any of these times (s).
SLACK_S = float(os.environ.get("FAULTS_SLACK", "1"))


def _limit(topic: str) -> float:
    return float(LIMITS[topic].default)


def bounds(site: Site) -> dict[str, float]:
    """Return each bound by its name (s), from the fault until the pump stands.

    Args:
        site: of the campaign.
    """
    pump = {parameter.name: parameter.default for parameter in parameters_of_pump(site)}
    follow, tolerance = float(pump["follow_time"]), float(pump["level_tolerance"])
    exchange = 2 * DriveEndpoint.period
    end = exchange + RAMP_S + SLACK_S
    # The line is left silent if the speed has not fallen for this long.
    runs_on = OBEYS_S + DRIVE_TIMEOUT_S + exchange + end
    step = site.tau + end
    frozen, jump = 0.01, 0.02
    flow = flow_at(site, 1.0, 2.0)
    return {
        # A rule of the pump node, or of the controller: one tick until it acts.
        "step": site.tau + step,
        # The median of five readings, one a second, lags by two readings.
        "filtered": 3.0 + site.tau + step,
        "command": _limit("/pump/command") + step,
        "level": _limit("/cistern/level") + site.tau + step,
        # The same for an intermittent level: it first arrives for 2 s.
        "intermittent": 2.0 + _limit("/cistern/level") + site.tau + step,
        "frost": _limit("/weather/frost") + step,
        # The drive stops automatically, or bringup stops it.
        "drive": DRIVE_TIMEOUT_S + end,
        # A hold reaches a user's own driver with the next message, of which there is one a second.
        "held": 1.0 + step,
        # The speed comes no nearer to what is requested.
        "follow": follow + step,
        # A level that does not change although the pump moves water.
        "cistern frozen": frozen * site.a1 / flow + _limit("/cistern/level") + step,
        "roof frozen": frozen * site.a2 / flow + _limit("/roof/level") + step,
        # A gauge's value only stops counting, but its silence must be reported.
        "switch": _limit("/outlet/open_switch") + step,
        "gauge": _limit("/gauge/precipitation") + step,
        # As "drive", but each request is answered by an exception, which is a sign of life for the
        # drive: two connections are tried first, after the first wait and after twice that wait.
        "refused": DRIVE_TIMEOUT_S + exchange + 3 * FIRST_WAIT_S + end,
        # A meter shows flow although the drive reports rest; then the line is left silent.
        "flows on": AFTERFLOW_S + step + exchange + DRIVE_TIMEOUT_S + end,
        "runs on": runs_on,
        # The connection breaks twice before the fault is noticed, and is made again each time.
        "runs on, breaks": runs_on + 2 * (FIRST_WAIT_S + exchange),
        # Nothing is sent for at most the longest timeout that is relied on, but a requested stop.
        "longest silence": float(pump["drive_timeout_limit"]) + exchange + end,
        "requested": exchange + step,
        # Two connections are tried on which nothing can be written.
        "refusing": DRIVE_TIMEOUT_S + 5.0 + end,
        "intermittent drive": 2.0 + DRIVE_TIMEOUT_S + end,
        "full disk": FLUSH_S + 5.0 + step,
        "limit": LIMIT_S + step,
        # The delivery check: the volume that may be missing, and the averaging in addition.
        "undelivered": tolerance * site.a2 / (MIN_DELIVERY * flow) + 2 * AVERAGING_S + step,
        # The same for the cistern, whose level falls while its pump is off.
        "welded": tolerance * site.a1 / flow + 2 * AVERAGING_S + step,
        # Random: two medians of five readings must differ by more than the tolerance.
        "noisy": 4 * _limit("/cistern/level") + step,
        "drift": jump / 2e-4 + step,
    }


def valve_bounds(site: Site) -> dict[str, float]:
    """Return each bound of a valve by its name (s), from the fault until the valve is closed.

    Args:
        site: of the campaign, with a valve.
    """
    exchange = 2 * RelayEndpoint.period
    end = exchange + TRAVEL_S + SLACK_S
    step = site.tau + end
    alarm = SENSOR_S + site.tau + SLACK_S
    flow = low_outlet_flow(plant_parameters(site), site.cistern_volume(site.z_o))
    water = LEAK_TOLERANCE_M * site.a1
    return {
        # A rule of the valve node, which acts at once; a sensor, or weather, in addition.
        "step": step,
        "sensor": SENSOR_S + site.tau + step,
        "command": _limit("/outlet/command") + step,
        "level": _limit("/cistern/level") + site.tau + step,
        "switch": _limit("/outlet/open_switch") + step,
        "gauge": _limit("/gauge/precipitation") + site.tau + step,
        # The weather node first finds that the thermometer is silent.
        "thermometer": _limit("/gauge/temperature") + 2 * site.tau + step,
        # The relay switches off automatically, and then the valve closes.
        "relay": DRIVE_TIMEOUT_S + end,
        # Opened by hand for some time.
        "by hand": BY_HAND_S + step,
        "limit": LIMIT_S + step,
        "released": RELEASED_M3 / (0.5 * flow) + step,
        # Alarms of a valve that does not follow.
        "travel": LONGEST_TRAVEL_S + exchange + alarm,
        "leak": water / LEAK + 2 * VALVE_AVERAGING_S + LONGEST_TRAVEL_S + exchange + alarm,
        "drained": water / (0.5 * flow) + 2 * VALVE_AVERAGING_S + LONGEST_TRAVEL_S + exchange
        + alarm,
        # An open valve that drains nothing, for as long as it takes to drain something.
        "not drained": max(DRAINS_FOR_S, 3 * water / (0.5 * flow)) + LONGEST_TRAVEL_S + exchange
        + alarm,
    }
