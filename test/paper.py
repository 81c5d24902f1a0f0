"""The paper's equations again, written from its text and independent of the package.

The tests check the package against them. All functions take numbers or arrays. The smooth model
also takes complex numbers, so its derivatives come from complex steps instead of calculus.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import polars
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from places import CONFIG

from greenroof_ros.base.command_line import Parser
from greenroof_ros.controllers.lookahead import Lookahead
from greenroof_ros.controllers.registry import ControllerChoice, find_controller
from greenroof_ros.forecast.choice import ForecastChoice
from greenroof_ros.forecast.steps import make_forecast
from greenroof_ros.physics.parameters import Flows, State, plant_parameters
from greenroof_ros.physics.pump import SensorAndPump
from greenroof_ros.physics.tick import OWN_PUMPS, step
from greenroof_ros.physics.virtual_site import VirtualSite
from greenroof_ros.simulation.inputs import find_needs
from greenroof_ros.simulation.loop import Simulation
from greenroof_ros.simulation.options import add_run_arguments, build_run
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.file import format_site, read_site
from greenroof_ros.site.site import Site
from greenroof_ros.weather.series import Weather, WeatherSeries

TABLE_I: dict[str, float] = {
    "a1": 25, "a2": 68.8, "a_pump": 0.01 * math.pi, "a_in": 0.305**2 * math.pi,
    "a_hat": -5.78e5, "c_hat": 55.2, "c_d": 0.61, "d": 16, "D": 0.2, "epsilon": 0.5, "F": 3.56,
    "g": 9.81, "K": 7.83e-8, "k_L": 0.6, "l": 18.4, "M": 10, "N": 43200, "r_o": 0.125, "tau": 1,
    "x2_star": 68.8 * 4.57e-2, "z_cap": 68.8 * 0.5, "z_H": 0.6, "z_o": 3, "z_pump": 0.15,
    "z_soil": 0.5, "z_veg": 4.57e-2,
}
"""Every row of Table I except pi, which is not a setting."""

PAPER_SITE = Site(**TABLE_I)  # type: ignore[arg-type]  # M and N are written as whole numbers

SLOW = replace(PAPER_SITE, tau=10.0)

VALVE: dict[str, Any] = {
    "low_outlet_level": 1.0, "low_outlet_radius": 0.02, "low_outlet_valve": True, "a_in": 300.0,
}
"""Keys of a site file: a valve takes 2.8 m3/h at a head of 1.5 m; roofs drain into the cistern."""

LIMITED: dict[str, Any] = {
    "time_zone": "America/Toronto", "quiet_hours": ("22:00-01:30", "12:00-13:00"),
    "tau": 60.0, "M": 1,
}
LIMITED_VALVE = read_site(CONFIG / "site.yaml", {
    **VALVE, **LIMITED, "valve_closed_in_frost": True,
})
LIMITED_WHOLE = replace(LIMITED_VALVE, valve_moves_per_hour=4.0)
LIMITED_SOIL = read_site(CONFIG / "site_neubrandenburg.yaml", LIMITED)
"""Sites that together have everything that limits commands; the clocks change on 14 March."""

IMPERFECT = {
    "roof_noise": 0.002, "roof_offset": -0.001, "noise_seed": 2, "pump_min_on": 300.0,
    "pump_min_off": 1200.0,
}

FIRST_OF_FOUR_DAYS = datetime(2021, 3, 12, 5, tzinfo=timezone.utc)

ONOFF = find_controller("onoff")

MIDNIGHT = datetime.fromisoformat("2021-07-07T00:00+00:00")

_STEP = 1e-30


def paper_run(*options: str) -> Run:
    """Build a run like a command line with these options, of ``mpc`` unless they name another."""
    parser, options = Parser(), ("--controller", "mpc", *options)
    add_run_arguments(parser, options)
    return build_run(parser.parse_args(options))


def weather_of(
    rain: ArrayLike, evapotranspiration: ArrayLike = 2.0,
    first: datetime = MIDNIGHT,
    **quantities: NDArray[np.float64],
) -> Weather:
    """Return hours of mm/h and mm/day (a scalar for all hours, or arrays), and other quantities.

    Rain of shape (hours, 60) is that of minutes.
    """
    fallen = np.array(rain, dtype=float)
    minutes = fallen if fallen.ndim > 1 else None
    hourly = fallen if minutes is None else fallen.mean(axis=1)
    dry = np.array(np.broadcast_to(evapotranspiration, hourly.shape), dtype=float)
    values = {"precipitation": hourly, "evapotranspiration": dry, **quantities}
    return Weather((Path("drawn.csv"),), first, values, "drawn", minutes=minutes)


def four_days(minutes: int = 60) -> polars.DataFrame:
    """Return March weather: storms, drizzle and long dry hours, and frost in every night."""
    rows = 4 * 1440 // minutes
    times = [FIRST_OF_FOUR_DAYS + timedelta(minutes=minutes * row) for row in range(rows)]
    chance = np.random.default_rng(4)
    rain = chance.gamma(0.5, 6.0, rows) * (chance.random(rows) < 0.15)
    hours = np.arange(rows) * minutes // 60
    return polars.DataFrame({
        "time": [time.isoformat() for time in times], "precipitation [mm/h]": rain.round(2),
        "temperature [degC]": 5.0 - 7 * np.cos(2 * np.pi * (hours - 5) / 24),
        "my evapotranspiration [mm/day]": 1.0 + hours % 7,
    })


def run_in(
    weather: Weather, site: Site, x1: float, x2: float, *, choice: ControllerChoice = ONOFF,
    after_h: float = 0.0, length_h: float | None = None, **parameters: Any,
) -> Run:
    """Build a run, by default of plain on/off; the site can be one that no file may describe.

    Args:
        weather: its weather.
        site: its site.
        x1: initial volume in the cistern (m3).
        x2: initial volume on the roof (m3).
        choice: its controller.
        after_h: start of the run (h since the first record).
        length_h: length of the run (h), by default up to the end of the records; in whole ticks.
        parameters: parameters of the controller and of the valve.
    """
    start = weather.first + timedelta(hours=after_h)
    steps = max(1, int((length_h or weather.hours - after_h) * 3600 / site.tau + 1e-9))
    series = WeatherSeries(weather, site, start, steps)
    values = choice.complete_parameters(site, parameters)
    forecast = make_forecast(
        weather, series, site, start, values.get("horizon", 0.0), ForecastChoice(),
        *find_needs(choice, values),
    )
    return Run(
        weather.files[0], site, weather, series, forecast, start, steps, choice, values, "custom",
        x1, x2,
    )


def run_of_hours(
    hours: Sequence[tuple[float, float, bool]], x1: float, x2: float, site: Site = SLOW,
    **given: Any,
) -> Run:
    """Build a run of plain on/off with :func:`run_in`.

    Args:
        hours: rain (mm/h), evapotranspiration (mm/day), and whether there is frost, of each hour.
        x1: initial volume in the cistern (m3).
        x2: initial volume on the roof (m3).
        site: its parameters; by default the paper's, with ticks of ten seconds.
        given: other arguments of :func:`run_in`.
    """
    first = datetime.fromisoformat("2021-07-07T00:00-05:00")
    rain, evapotranspiration, frost = (np.array(part) for part in zip(*hours, strict=True))
    weather = weather_of(rain, evapotranspiration, first, temperature=np.where(frost, -1.0, 1.0))
    return run_in(weather, site, x1, x2, **given)


def find_wet(rain: NDArray[np.float64], tau: float, wet_after: float) -> NDArray[np.bool_]:
    """Return whether it is wet in each tick: the words of the rule.

    Rain counts at 0.1 mm/h, or within an hour after rain that counted.

    Args:
        rain: rain rate in each tick (mm/h).
        tau: duration of a tick (s).
        wet_after: time after rain that counts as wet weather (h).
    """
    last, wet = -math.inf, []
    for tick, rate in enumerate(rain.tolist()):
        since = (tick - 1 - last) * tau / 3600
        if rate > 0.1 - 1e-9 or (rate > 0 and since < 1):
            last = tick
        wet.append(last == tick or since < wet_after)
    return np.array(wet)


def site_with(**changes: float) -> Site:
    """Return the paper's site with other values; x2_star and z_cap follow from them."""
    site = replace(PAPER_SITE, **changes)  # type: ignore[arg-type]
    return replace(site, x2_star=site.a2 * site.z_veg, z_cap=site.a2 * site.z_soil)


def site_file(directory: Path, *, base: str = "site.yaml", **changes: float) -> Path:
    """Write a packaged site file with changed and additional values; products are left out."""
    path = directory / "site.yaml"
    lines = format_site(read_site(CONFIG / base)).splitlines()
    left_out = {*changes, "x2_star", "z_cap"}
    unchanged = [line for line in lines if line.partition(":")[0] not in left_out]
    changed = [f"{key}: {value!r}" for key, value in changes.items()]
    path.write_text("\n".join([*unchanged, *changed]) + "\n", encoding="utf-8")
    return path


def lookahead(site: Site = PAPER_SITE, **changes: float) -> Lookahead:
    """Return a 12 h lookahead that uses readings unfiltered, and waits for rain without limit."""
    parameters = {
        "horizon": 12.0, "observer_time_constant": 0.0, "waiting_budget": math.inf, **changes,
    }
    choice = find_controller("lookahead")
    controller = choice.make(site, choice.complete_parameters(site, parameters))
    assert isinstance(controller, Lookahead)
    return controller


def rain_scaled(run: Run, factor: float) -> Run:
    """Return a run with its rain multiplied and its forecast unchanged."""
    rain = run.weather.precipitation * factor
    weather = replace(run.weather, values={**run.weather.values, "precipitation": rain})
    return replace(
        run, weather=weather, series=WeatherSeries(weather, run.site, run.start, run.steps)
    )


def virtual_site(x1: float, x2: float, site: Site = PAPER_SITE) -> VirtualSite:
    """Return a site with exact sensors and pumps, and with these volumes (m3)."""
    return VirtualSite(site, x1, x2, 0, SensorAndPump())


def advance(
    plant: VirtualSite, rain: float, potential: float, command: float, pumped: float = OWN_PUMPS
) -> Flows:
    """Let a tick of a site pass, and return its flows; see :meth:`.VirtualSite.act`."""
    flows = plant.act(rain, potential, command, pumped)
    plant.step()
    return flows


def tick_of(
    site: Site, x1: float, x2: float, rain: float = 0.0, potential: float = 0.0,
    command: float = 0.0, pumped: float = OWN_PUMPS,
) -> tuple[State, Flows]:
    """Return the state after a tick with an open outlet, and its flows; see :func:`.tick.step`."""
    state = State(x1, x2, site.initial_layer)
    return step(plant_parameters(site), state, rain, potential, command, 1.0, pumped)


def metrics_of(run: Run, controller: Any = None) -> dict[str, float]:
    """Return the metrics of a run, with its own controller or with the given one."""
    simulation = Simulation(run, controller)
    deque(simulation.ticks(), maxlen=0)
    return simulation.metrics.results(simulation.site.state).metrics


def deviation_of(run: Run, controller: Any = None) -> float:
    """Return the total deviation of a run (m3 s), with its own controller or with the given one."""
    return metrics_of(run, controller)["total_deviation_m3"] * run.site.tau


@st.composite
def sites(draw: st.DrawFn) -> Site:
    """Draw a site that a user could define, from a rain barrel to a reservoir."""

    def between(minimum: float, largest: float) -> float:
        return draw(st.floats(minimum, largest))

    z_soil, z_pump, z_H, d = between(0.05, 2), between(0, 1), between(0, 2), between(1, 40)
    return site_with(
        a1=between(0.5, 5000), a_in=between(0.01, 5000), z_o=d * between(0.01, 0.76),
        r_o=between(0.01, 1), c_d=between(0.1, 1),
        a2=between(0.5, 50000), z_soil=z_soil, z_veg=z_soil * between(0.01, 0.99),
        K=between(1e-9, 1e-3),
        a_hat=-between(1e2, 1e7), c_hat=max(d - z_pump - z_H, 0) + between(0.1, 50), d=d,
        a_pump=between(1e-3, 0.1), D=between(0.01, 0.5), F=between(0.01, 5), k_L=between(0, 5),
        l=between(1, 100), z_pump=z_pump, z_H=z_H, g=between(9.7, 9.9),
        epsilon=between(0.01, 5), tau=draw(st.sampled_from([0.5, 1.0, 2.0, 10.0])),
    )


@st.composite
def field_capacity_sites(draw: st.DrawFn) -> Site:
    """Draw a site with a field-capacity soil, with or without a layer, mains and low outlet."""
    site = draw(st.just(PAPER_SITE) | sites())
    wilting = draw(st.just(0.0) | st.floats(0.0, 0.2))
    capacity = wilting + draw(st.floats(0.05, 0.7))
    # The target is below field capacity, and can be below the wilting point.
    z_veg = site.z_soil * capacity * draw(st.floats(0.01, 0.99))
    layer = draw(st.none() | st.tuples(st.floats(0.001, 0.1), st.floats(1.0, 1e5)))
    layer_filled = draw(st.just(0.0) | st.floats(0.0, 1.0)) if layer else 0.0
    mains = draw(st.none() | st.tuples(st.floats(0.01, 0.99), st.floats(1e-6, 1.0)))
    low = draw(st.none() | st.tuples(st.floats(0.01, 0.99), st.floats(0.001, 0.2)))
    exponent = draw(st.sampled_from([1.0, 2.0, 10.0]) | st.floats(1.0, 10.0))
    needed = draw(st.none() | st.floats(0.0, 1e5))
    lowest = site.suction_level
    return replace(
        site,
        runoff_coefficient=draw(st.just(1.0) | st.floats(0.01, 1.0)),
        low_outlet_level=low and low[0] * site.z_o,
        low_outlet_radius=low and low[1],
        low_outlet_valve=draw(st.booleans()) if low else False,
        drainage_to_cistern=draw(st.sampled_from([0.0, 1.0]) | st.floats(0.0, 1.0)),
        # This level ignores the low outlet, but any level serves for a balance.
        mains_level=mains and lowest + mains[0] * abs(site.z_o - lowest),
        mains_flow=mains and mains[1],
        z_veg=z_veg, x2_star=site.a2 * z_veg, z_cap=site.a2 * site.z_soil * capacity,
        field_capacity=capacity, wilting_point=wilting, depletion_fraction=draw(st.floats(0, 0.9)),
        percolation_exponent=exponent,
        monthly_other_demand=None if needed is None else (needed,) * 12,
        drainage_storage=layer and layer[0], drainage_time=layer and layer[1],
        initial_layer=layer_filled * site.a2 * layer[0] if layer else 0.0,
    )


ANY_SITE = st.just(PAPER_SITE) | sites() | field_capacity_sites()


def exact_flows(
    site: Site, x1: float, x2: float, u: float, valve: float = 1.0
) -> tuple[float, float, float]:
    """Return q_out, q_pump and q_drain (m3/s) of Eqs. (2)-(4), with the valve open to a share."""
    outlet = site.c_d * math.pi * site.r_o**2
    q_out = q_pump = q_drain = 0.0
    if x1 / site.a1 > site.z_o:
        q_out = outlet * math.sqrt(2 * site.g * (x1 / site.a1 - site.z_o))
    if site.low_outlet_level is not None and x1 / site.a1 > site.low_outlet_level:
        assert site.low_outlet_radius is not None
        low = site.c_d * math.pi * site.low_outlet_radius**2
        q_out += valve * low * math.sqrt(2 * site.g * (x1 / site.a1 - site.low_outlet_level))
    if not (x2 / site.a2 >= site.z_veg or x1 / site.a1 < site.z_pump + site.z_H):
        q_pump = u * math.sqrt((x1 / site.a1 + site.c_hat - site.d) / _head_loss(site))
    if not x2 < site.z_cap:
        q_drain = site.K * site.a2 * (x2 / site.a2 + site.z_soil) / site.z_soil
    return q_out, q_pump, q_drain


def _head_loss(site: Site) -> float:
    """Head loss of pipe and pump together per squared flow: b to the power of -2."""
    return (site.F * site.l / site.D + site.k_L) / (2 * site.g * site.a_pump**2) - site.a_hat


def _psi(y: Any, epsilon: float) -> Any:
    """Eq. (6)."""
    root = np.where(np.real(y) > 0, y, 1) ** 0.5
    low = 2 / 3 * epsilon**0.5
    middle = root**3 / (3 * epsilon) + low
    return np.where(np.real(y) <= 0, low, np.where(np.real(y) <= epsilon, middle, root))


def _sigma(exponent: Any) -> Any:
    """1 / (1 + exp(exponent)); beyond 700 it is below 1e-304, and exp would overflow."""
    return 1 / (1 + np.exp(np.where(np.real(exponent) > 700, 700, exponent)))


def smooth_rates(site: Site, x1: Any, x2: Any, u: Any, rain: Any, evaporated: Any) -> Any:
    """Return f^epsilon of Eqs. (5)-(9) (m3/s), complex, shape (..., 2); a valve is closed."""
    # In two parts: numpy's complex division rounds twice, which shows near nu = 0.
    level = np.real(x1) / site.a1 + 1j * np.imag(x1) / site.a1
    outlet = site.c_d * math.pi * site.r_o**2
    q_out = outlet * math.sqrt(2 * site.g) * _psi(level - site.z_o, site.epsilon)
    if site.low_outlet_level is not None and not site.low_outlet_valve:
        assert site.low_outlet_radius is not None
        low = site.c_d * math.pi * site.low_outlet_radius**2
        q_out = q_out + low * math.sqrt(2 * site.g) * _psi(
            level - site.low_outlet_level, site.epsilon
        )
    eta = u / math.sqrt(_head_loss(site)) * _psi(level + site.c_hat - site.d, site.epsilon)
    sigma_1 = _sigma((site.a1 * (site.z_pump + site.z_H) - x1) / site.epsilon)
    sigma_2 = _sigma((x2 - site.a2 * site.z_veg) / site.epsilon)
    q_pump = eta * sigma_1 * sigma_2
    darcy = site.K * site.a2 * (x2 / site.a2 + site.z_soil) / site.z_soil
    q_drain = darcy * _sigma((site.z_cap - x2) / site.epsilon)
    f1 = rain * site.a_in * site.runoff_coefficient - q_out - q_pump
    if site.mains_level is not None:
        f1 = f1 + np.where(np.real(x1) / site.a1 < site.mains_level, site.mains_flow, 0)
    if site.field_capacity is None:
        f2 = rain * site.a2 + q_pump - evaporated - q_drain
    else:
        f2 = _measured_rate(site, x2, rain * site.a2 + q_pump, evaporated)
    return np.stack([f1, f2], axis=-1)


def _measured_rate(site: Site, x2: Any, arriving: Any, evaporated: Any) -> Any:
    """HBV's soil routine, FAO-56's Eq. 84, and no water above field capacity."""
    assert site.field_capacity is not None
    assert site.wilting_point is not None
    assert site.depletion_fraction is not None
    wilting = site.a2 * site.z_soil * site.wilting_point
    depleted = site.z_cap - x2
    available = site.z_cap - wilting
    filled = np.where(np.real(x2) < wilting, 0, (x2 - wilting) / available)
    filled = np.where(np.real(depleted) <= 0, 1, filled)
    stress = filled / (1 - site.depletion_fraction)
    stress = np.where(np.real(stress) < 1, stress, 1)
    excess = np.where(np.real(depleted) < 0, -depleted, 0) / site.tau
    return arriving - filled**site.percolation_exponent * arriving - stress * evaporated - excess


def linear_model(site: Site, *point: Any) -> tuple[Any, Any, Any, Any]:
    """Return A - I, B, C and b of Eq. (10) at points (x1, x2, u, w_r, w_e), by complex steps.

    The caller adds the identity, because it would swamp the digits of tau df/dx.
    """
    points = [np.asarray(value, dtype=float) for value in point]
    columns = []
    for index in range(len(points)):
        moved: list[Any] = list(points)
        moved[index] = moved[index] + 1j * _STEP
        columns.append(np.imag(smooth_rates(site, *moved)) / _STEP)
    slopes = site.tau * np.stack(columns, axis=-1)
    b = site.tau * np.real(smooth_rates(site, *points))
    return slopes[..., :2], slopes[..., 2], slopes[..., 3:], b
