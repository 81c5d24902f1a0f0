"""A budget for the cost of waiting for forecast rain."""

from __future__ import annotations

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.physics.parameters import State, plant_parameters
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.physics.soil import retained_share
from greenroof_ros.physics.tick import OWN_PUMPS, step
from greenroof_ros.site.site import Site

# Water lost to a low outlet cannot be pumped until it rains: it counts as missing for this long
# (s).
_LOST_S = 604_800.0

WAITING_BUDGET = Parameter(
    "waiting_budget", 72.0, "h", 0.0, 1e6,
    "maximum extra cost of waiting for rain compared with plain on/off control, in hours of an "
    "empty roof, above which forecasts of rain are ignored",
)
WAITING_SHARE = Parameter(
    "waiting_share", 0.05, "1", 0.0, 1.0,
    "addition to waiting_budget, as a share of the cost of plain on/off control so far",
)


class RegretBudget:
    """Limits the extra cost of waiting for rain, compared with plain on/off control.

    A controller that leaves room for rain that does not come is worse off than the on/off
    controller, which has filled the roof. No rule can avoid this loss: while the controller waits,
    a true forecast and a false one look the same. But the loss can be limited. This class tracks
    how the volumes on the roof and in the cistern would differ now under on/off control, Eq. (12).
    Since only the differences are tracked, errors of the model and the sensor affect both
    controllers alike. The class adds up

        L = sum of tau (|x2 - x2*| - |x2_onoff - x2*|),   D = sum of tau |x2_onoff - x2*|.

    A gain from waiting counts as a negative loss, and pays for later losses. If L, plus the cost of
    filling the roof as on/off control has done, is above

        waiting_budget x2* + waiting_share D,

    forecasts of rain are ignored, and the controller fills the roof as on/off control would.
    Forecasts are used again once the roof has been filled and L is within the limit, which grows
    with D. So at any time, whatever the forecasts predict, if on/off control has cost D, this
    controller has cost no more than

        (1 + waiting_share) D + waiting_budget x2*,

    apart from the loss in one tick, the time that the pumps must wait before their next start, and
    the time by which evapotranspiration prolongs the filling. The reason is that L is below the
    limit while forecasts are used, and that the limit already covers the filling of the roof when
    they cease to be used. Such a guarantee is called the robustness of an online algorithm with
    predictions; the benefit from accurate predictions is called its consistency (Lykouris and
    Vassilvitskii 2021, Competitive Caching with Machine Learned Advice, J. ACM 68(4),
    doi:10.1145/3447579). In frost, pumping is not allowed, so the loss continues.

    If the cistern overflows while the controller waits, the site loses water that on/off control
    would have pumped by then. The lost water costs nothing until a drought empties the cistern.
    From then on the water is missing, and L grows until the drought ends, regardless of the limit.
    This loss is counted when it occurs, and forecasts are ignored until D has made up for it. The
    loss can therefore happen once, but not in every drought.

    While the controller waits, a low outlet of the cistern can drain the water meant for the roof.
    The volume that on/off control would have on the roof, minus the volume that will stay in the
    cistern, counts as if it were missing for a week.

    If the mains fill the cistern more slowly than the pumps empty it, and the cistern holds less
    than the roof lacks, filling takes longer than assumed, and L can exceed the limit.

    The budget belongs to a site: a restarted live controller continues with its previous L and D.

    The comparison assumes that the pumps follow their commands. With minimum on-times and
    off-times, or with a pump flow other than the one in the site file, L and D are wrong by the
    resulting difference.

    Attributes:
        loss: L so far (m3 s); a negative value is a gain.
        onoff_cost: D so far (m3 s).
        exhausted: whether forecasts of rain are ignored.
    """

    def __init__(self, site: Site, waiting_budget: float, waiting_share: float) -> None:
        """Set the site and the limit.

        Args:
            site: parameters of the site (Table I).
            waiting_budget: time (h) with an empty roof that costs as much as the budget.
            waiting_share: share of the cost of on/off control (1).
        """
        self._site, self._p = site, plant_parameters(site)
        self._budget = waiting_budget * 3600 * site.x2_star  # m3 s
        self._share = waiting_share
        self._more = 0.0  # volume on the roof with on/off minus the actual volume (m3)
        self._stored = 0.0  # the same in the cistern (m3)
        self._layers = site.initial_layer, site.initial_layer  # with on/off, and actually (m3)
        self.loss = 0.0
        self.onoff_cost = 0.0
        self.exhausted = False

    def judge(self, x1: float, x2: float, fraction: float, seconds: float) -> bool:
        """Count the current tick, and return whether forecasts of rain are to be ignored.

        Args:
            x1: volume in the cistern (m3).
            x2: volume on the roof (m3).
            fraction: v, the command of on/off control while pumping (share of the maximum flow).
            seconds: time since the last call (s), in which skipped ticks count, too.
        """
        site = self._site
        theirs = abs(x2 + self._more - site.x2_star)
        excess = abs(x2 - site.x2_star) - theirs
        self.onoff_cost += seconds * theirs
        self.loss += seconds * excess
        # Volume to pump to catch up with on/off, or to reach the target.
        behind = max(0.0, min(self._more, site.x2_star - x2))
        flow = fraction * maximum_pump_flow(self._p, x1)
        drained, stays = self._drained(x1, x2), retained_share(self._p, x2) * flow
        cost = self.loss + drained
        if stays > 0:  # filling the roof to the target later than on/off control
            missing = max(0.0, site.x2_star - x2 - self._more)  # on the roof with on/off
            cost += behind * (missing + behind / 2) / stays
        if cost > self._budget + self._share * self.onoff_cost:
            self.exhausted = True
        # A controller that follows on/off is a tick behind it until both have filled the roof.
        elif behind <= site.tau * flow / 2:
            self.exhausted = False
        return self.exhausted

    def move(
        self, x1: float, x2: float, fraction: float, command: float,
        precipitation: float = 0.0, evapotranspiration: float = 0.0,
    ) -> State:
        """Advance the comparison by one tick; return the water in the plant after the tick.

        Args:
            x1: volume in the cistern (m3).
            x2: volume on the roof (m3).
            fraction: as for :meth:`judge`.
            command: the actual command.
            precipitation: rain in the tick (m/s).
            evapotranspiration: evapotranspiration from the whole bed (m3/s), for plants without
                water stress.
        """
        outlet = float(self._site.always_drains)
        theirs = State(max(0.0, x1 + self._stored), max(0.0, x2 + self._more), self._layers[0])
        theirs, ours = (
            step(self._p, state, precipitation, evapotranspiration, share, outlet, OWN_PUMPS)[0]
            for state, share in ((theirs, fraction), (State(x1, x2, self._layers[1]), command))
        )
        self._stored, self._more = theirs.cistern - ours.cistern, theirs.roof - ours.roof
        self._layers = theirs.layer, ours.layer
        return ours

    def _drained(self, x1: float, x2: float) -> float:
        """Return the cost (m3 s) of drained water that on/off control would have pumped."""
        site = self._site
        if not site.always_drains or site.low_outlet_level is None:
            return 0.0
        stays = min(x1, site.cistern_volume(site.low_outlet_level))
        usable = max(0.0, stays - site.cistern_volume(site.suction_level))
        return max(0.0, self._more - retained_share(self._p, x2) * usable) * _LOST_S
