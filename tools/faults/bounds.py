"""How long the pump may go on after a fault: what the documentation says, from the code's defaults.

doc/reference/interlocks.md and doc/reference/live-inputs.md state the same figures.
"""

from __future__ import annotations

from greenroof_ros.drives.exchange import FIRST_WAIT_S, RUNS_ON_S, SEEN_S, SILENCE_MARGIN_S
from greenroof_ros.graph import supervision
from greenroof_ros.graph.live import LIMITS
from greenroof_ros.graph.supervisor import ENDING_S, PERMIT_S, SILENT_S
from greenroof_ros.model.pump_speed import flow_at
from greenroof_ros.model.site import Site
from greenroof_ros.nodes.pump import parameters as parameters_of_pump
from greenroof_ros.recording.bag_writer import FLUSH_S

# Of the simulated drive, as the campaign starts it: from rated speed to rest, and its own timeout.
RAMP_S = 1.0
DRIVE_TIMEOUT_S = 5.0
# How long bringup hears nothing of a node before it kills it: its default.
SILENCE_S = 5.0
# For how long the pump may run where a case is about the limit of a run or of a day, instead of the
# default.
LIMIT_S = 20.0
# What a busy machine may add to any of these, and what measuring adds.
SLACK_S = 1.0
# Of a simulation, to the end of bringup: silence is noticed, and all nodes are ended.
SIMULATION_END_S = SILENCE_S + ENDING_S + SLACK_S


def _limit(topic: str) -> float:
    return float(LIMITS[topic].default)


def bounds(site: Site) -> dict[str, float]:
    """Return each bound by its name (s), from the fault to a pump that stands.

    Args:
        site: of the campaign.
    """
    pump = {parameter.name: parameter.default for parameter in parameters_of_pump(site)}
    exchange, follow, apart, ramp, averaging, tolerance, delivery = (
        float(pump[name])
        for name in ("exchange_period", "follow_time", "follow_tolerance", "drive_ramp",
                     "averaging_time", "level_tolerance", "least_delivery")
    )
    exchange *= 2
    end = exchange + RAMP_S + SLACK_S
    # It is left in silence when its speed has not fallen for so long.
    runs_on = RUNS_ON_S + SEEN_S + SILENCE_MARGIN_S + DRIVE_TIMEOUT_S + exchange + end
    step = site.tau + end
    frozen, jump = 0.01, 0.02
    flow = flow_at(site, 1.0, 2.0)
    return {
        # A rule of the pump node, or of the controller: the tick in which it acts.
        "step": site.tau + step,
        # The median of five readings of a sensor a second is the one of two readings ago.
        "filtered": 3.0 + site.tau + step,
        "command": _limit("/pump/command") + step,
        "level": _limit("/cistern/level") + site.tau + step,
        # The same, of what comes and goes: it is there for 2 s first.
        "intermittent": 2.0 + _limit("/cistern/level") + site.tau + step,
        "frost": _limit("/weather/frost") + step,
        # The permit: at once for a node that ended, after its silence for one that hangs.
        "permit": supervision._GREATEST_AGE_S + step,
        "silent": SILENT_S + PERMIT_S + step,
        # The drive stands by itself, or bringup stops it.
        "drive": DRIVE_TIMEOUT_S + end,
        "supervised": SILENCE_S + end,
        # So long the slowest ramp that is allowed explains it.
        "follow": apart * ramp + follow + step,
        # A level that does not move while the pump moves the water.
        "cistern frozen": frozen * site.a1 / flow + _limit("/cistern/level") + step,
        "roof frozen": frozen * site.a2 / flow + _limit("/roof/level") + step,
        # The delivery check: the volume that may be missing, and the averaging that comes on top.
        # A gauge only counts less; that it is silent must be said.
        "gauge": _limit("/gauge/precipitation") + step,
        # The same, where each request is answered by an exception and counts as life: two
        # connections are tried first, after the first wait and twice that.
        "refused": DRIVE_TIMEOUT_S + exchange + 3 * FIRST_WAIT_S + end,
        "runs on": runs_on,
        # Where it was judged, and once more before it was seen, the connection is made again.
        "runs on, breaks": runs_on + 2 * (FIRST_WAIT_S + exchange),
        # Two connections are tried on which nothing can be written.
        "refusing": DRIVE_TIMEOUT_S + 5.0 + end,
        "intermittent drive": 2.0 + DRIVE_TIMEOUT_S + end,
        "full disk": FLUSH_S + 5.0 + step,
        "limit": LIMIT_S + step,
        "undelivered": tolerance * site.a2 / (delivery * flow) + 2 * averaging + step,
        # The same of the cistern, whose level falls while its pump is off.
        "welded": tolerance * site.a1 / flow + 2 * averaging + step,
        # By chance: two medians of five readings must be farther apart than the tolerance.
        "noisy": 4 * _limit("/cistern/level") + step,
        "drift": jump / 2e-4 + step,
    }
