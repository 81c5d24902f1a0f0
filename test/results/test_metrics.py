"""Metrics: by hand, and with the same bits regardless of the blocks in which they are summed."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest
from paper import PAPER_SITE, site_with

from greenroof_ros.physics.plant import Flows, Plant
from greenroof_ros.physics.soil import soil_of
from greenroof_ros.results import metrics as metrics_module
from greenroof_ros.results.metrics import Metrics
from greenroof_ros.site.site import Site

KEPT = {"rain_kept_share", "rain_kept_share_hour", "rain_kept_share_day"}
Ticks = list[tuple[float, float, float, float, Flows]]


def drawn(count: int, seed: int) -> Ticks:
    """Draw ticks of cistern, roof, command, rain and flows; pumps start, run and stop."""
    chance = random.Random(seed)
    return [
        (
            chance.uniform(0, 100), chance.uniform(0, 4), chance.uniform(0, 1.5),
            chance.choice([0.0, chance.uniform(0, 1e-5)]),
            Flows(
                chance.uniform(0, 0.1), chance.choice([0.0, chance.uniform(0, 0.01)]),
                chance.uniform(0, 1e-4), chance.uniform(0, 1e-5), chance.random() < 0.1,
                chance.uniform(0, 1e-4),
            ),
        )
        for _ in range(count)
    ]


STILL = Flows(0.0, 0.0, 0.0, 0.0, False, 0.0)


def metrics_of(site: Site, ticks: Ticks) -> Metrics:
    """Return the metrics of ticks; the last tick is the end of the run."""
    plant = Plant(site, 0.0, 0.0)
    metrics = Metrics(site, plant)
    for plant.x1, plant.x2, command, rain, flows in ticks[:-1]:
        metrics.step(command, rain, rain + flows.evapotranspiration, flows)
    plant.x1, plant.x2 = ticks[-1][:2]
    return metrics


@pytest.mark.parametrize(("days", "weeks"), [(14, 2), (34, 5)])
def test_weeks(days: int, weeks: int) -> None:
    """Each week's deviation by hand, across blocks; the last tick counts in the last week."""
    site = replace(PAPER_SITE, tau=600.0)
    ticks = drawn(days * 144 + 1, seed=days)
    expected = [0.0] * weeks
    for k, tick in enumerate(ticks):
        expected[min(k // 1008, weeks - 1)] += abs(tick[1] - site.x2_star)
    metrics = metrics_of(site, ticks)
    assert metrics.weekly_deviations() == expected
    assert sum(expected) == pytest.approx(metrics["total_deviation_m3"], rel=1e-12)


def test_sums_by_hand() -> None:
    """Two ticks of 2 s and the end; the target is 3.14416 m3, and 0.157208 m3 from it is near.

    The cistern's inlet has 0.305^2 pi = 0.2922467 m2, the bed 68.8 m2.
    """
    results = metrics_of(site_with(tau=2.0), [
        (60.0, 3.0, 0.5, 1e-6, Flows(0.1, 0.004, 0.001, 2e-4, False, 0.0)),
        (50.0, 3.5, 1.25, 0.0, Flows(0.0, 0.0, 0.002, 1e-4, True, 0.0)),
        (40.0, 3.2, 0.0, 0.0, STILL),
    ]).results()
    expected = {
        "total_deviation_m3": 0.14416 + 0.35584 + 0.05584, "near_target_hours": 4 / 3600,
        "pumped_m3": 0.008, "outflow_m3": 0.2, "drainage_m3": 0.006,
        "evapotranspiration_m3": 6e-4, "rain_roof_m3": 1.376e-4, "rain_cistern_m3": 5.844933e-7,
        "rain_m3": 1.3818449e-4, "max_command": 1.25, "beyond_hours": 2 / 3600,
        "pump_hours": 2 / 3600, "final_cistern_m3": 40.0, "final_roof_m3": 3.2,
        "limited_steps": 1, "pump_starts": 1, "busiest_hour_starts": 1, "excess_starts": 0,
    }
    assert {name: results[name] for name in expected} == pytest.approx(expected, rel=1e-6)
    assert {name for name, value in results.items() if type(value) is int} == {
        "limited_steps", "pump_starts", "busiest_hour_starts", "excess_starts", "overflow_days",
    }
    # There is no valve, and no layer.
    assert not {"mains_m3", "demand_met_share", "final_layer_m3"} & results.keys()


@pytest.mark.parametrize(
    ("gap", "busiest"), [(1800, 20), (1799, 21)]
)
def test_an_hour_holds_its_first_start_no_more(gap: int, busiest: int) -> None:
    """Twenty starts 180 s apart fill it; the next comes as the first leaves. Ticks of 0.1 s."""
    site = site_with(tau=0.1)
    metrics = Metrics(site, Plant(site, 75.0, 1.0))
    for tick in range(30 * gap):
        metrics.step(1.0, 0.0, 0.0, STILL._replace(pump=0.004 * (tick % gap == 0)))
    assert metrics["pump_starts"] == 30
    assert metrics["busiest_hour_starts"] == busiest
    assert metrics["excess_starts"] == (10 if busiest > 20 else 0)


# The pumps deliver 0.00842205 m3/s at most (3 m): they run above 8.422e-5 m3/s.
@pytest.mark.parametrize(("flows", "starts", "ticks"), [
    ([0.008 * 0.5**k for k in range(1100)], 1, 7),  # a lag, down to 0: 0.008 / 2^6 is 1.25e-4
    ([0.004, 2.5e-323, 0.004, 2.5e-323], 2, 2),
    ([1e-6 * (k % 2) for k in range(100)], 0, 0),  # the noise of a flow meter
    ([8.42e-5, 8.43e-5, 8.42e-5], 1, 1),
])
def test_what_is_treated_as_running(flows: list[float], starts: int, ticks: int) -> None:
    metrics = metrics_of(site_with(tau=1.0), [
        *((75.0, 1.0, 1.0, 0.0, STILL._replace(pump=flow)) for flow in flows),
        (75.0, 1.0, 0.0, 0.0, STILL),
    ])
    assert metrics["pump_starts"] == starts
    assert metrics["pump_hours"] == pytest.approx(ticks / 3600)
    assert metrics["pumped_m3"] == pytest.approx(sum(flows))


def test_energy_and_starts_by_hand() -> None:
    """At 3 m the pumps deliver 0.00842205 m3/s at L = phi = 55.2 - 5.78e5 0.00842205^2 = 14.2 m.

    Half the flow needs 13 m plus a quarter of the 1.2 m of friction, with 9810 N/m3. A quarter of
    the electric energy becomes hydraulic.
    """
    full = 0.00842205211502804
    head = 55.2 - 5.78e5 * full**2
    flows = (full, full, 0.0, full / 2, 0.0, 0.0, full, 0.0)
    results = metrics_of(
        site_with(pump_efficiency=0.25),
        [(75.0, 1.0, 1.0, 0.0, STILL._replace(pump=flow)) for flow in flows],
    )
    joules = 9810 * (3 * full * head + full / 2 * (13 + (head - 13) / 4))
    assert results["hydraulic_energy_kwh"] == pytest.approx(joules / 3.6e6, rel=1e-9)
    assert results["electric_energy_kwh"] == 4 * results["hydraulic_energy_kwh"]
    assert results["pump_starts"] == 3


def test_mains_water_by_hand() -> None:
    """Three ticks of 2 s, with 0.001 m3/s from the mains in two, and 0.004 m3/s pumped in one.

    6 of 8 litres did not come from the mains. Who only refills a cistern has no such share, nor has
    who pumps nothing; a cistern that is refilled for later does not make it negative.
    """
    site = site_with(tau=2.0, mains_level=1.0, mains_flow=0.001)
    refilled, pumped = STILL._replace(mains=5e-4), STILL._replace(mains=5e-4, pump=0.004)
    for flows, mains, share in (
        ((refilled, pumped, STILL), 0.002, 0.75), ((refilled, STILL), 0.001, None),
        ((STILL._replace(mains=1e-3), STILL._replace(pump=5e-4)), 0.002, 0.0),
        ((STILL._replace(pump=0.004),), 0.0, 1.0),
    ):
        results = metrics_of(
            site, [(60.0, 1.0, 0.0, 0.0, moved) for moved in (*flows, STILL)]
        ).results()
        assert results["mains_m3"] == pytest.approx(mains, rel=1e-12)
        assert results.get("demand_met_share") == (share and pytest.approx(share, rel=1e-12))


def test_low_commands_make_pumps_run() -> None:
    """0.1 % of the full flow, 8.4e-6 m3/s, for two of three seconds: the noise of a meter does not.

    In ticks of a minute, half of the commanded flow is half a minute if the pumps stop in the tick.
    """
    full = 0.00842205211502804
    flows = [1e-3 * full, 1e-3 * full, 0.0, 1e-3 * full, 1e-6 * full]
    run = [(75.0, 1.0, 1e-3, 0.0, STILL._replace(pump=flow)) for flow in flows]
    metrics = metrics_of(PAPER_SITE, [*run, (75.0, 1.0, 0.0, 0.0, STILL)])
    assert (metrics["pump_hours"], metrics["pump_starts"]) == (pytest.approx(3 / 3600), 2)
    long = replace(PAPER_SITE, tau=60.0)
    # The first two cannot reach the target, 3.14416 m3: a meter that reads less is no shorter run.
    run = [(75.0, x2, 1.0, 0.0, STILL._replace(pump=full / 2)) for x2 in (1.0, 2.0, 2.7)]
    results = metrics_of(long, [*run, (75.0, long.x2_star, 0.0, 0.0, STILL)]).results()
    assert results["pump_hours"] == pytest.approx(150 / 3600)
    assert results["pump_starts"] == 1
    # While they run they have the head of the full flow, as in test_energy_and_starts_by_hand.
    head = 55.2 - 5.78e5 * full**2
    half = 13 + (head - 13) / 4
    joules = 9810 * 60 * full / 2 * (2 * half + head)
    assert results["hydraulic_energy_kwh"] == pytest.approx(joules / 3.6e6, rel=1e-9)


def test_an_owners_metrics_by_hand() -> None:
    """Ticks of 2 s: 0.1 m3 above the target, 0.3 below, empty twice, and 0.2 above at the end.

    The mean of 0.1, 0.3, 3.14416, 3.14416 and 0.2 m3 is 1.377664 m3, 20.0242 mm on 68.8 m2.
    """
    site, target = site_with(tau=2.0), PAPER_SITE.x2_star
    plant = Plant(site, 50.0, target + 0.1)
    metrics = Metrics(site, plant)
    for after, actual in ((target - 0.3, 4e-6), (0.0, 2e-6), (0.0, 1e-6), (target + 0.2, 0.0)):
        metrics.step(0.0, 0.0, 4e-6, STILL._replace(evapotranspiration=actual))
        plant.x2 = after
    results = metrics.results()
    assert results["mean_deviation_mm"] == pytest.approx(1377.664 / 68.8, rel=1e-12)
    assert results["stress_hours"] == pytest.approx(4 / 3600, rel=1e-12)
    assert results["evapotranspiration_ratio"] == pytest.approx(7 / 16, rel=1e-12)
    assert not KEPT & results.keys()  # it did not rain


def test_stress_is_the_soils() -> None:
    """34.4 m3 of soil with 30 % at field capacity, 10 % at wilting: stress below 20 %, 6.88 m3."""
    site = replace(
        PAPER_SITE, tau=3600.0, z_cap=10.32, field_capacity=0.3, wilting_point=0.1,
        depletion_fraction=0.5,
    )
    volumes = (12.0, 6.8801, 6.8799, 3.0, 0.0)
    metrics = metrics_of(site, [(50.0, x2, 0.0, 0.0, STILL) for x2 in (*volumes, 12.0)])
    assert metrics["stress_hours"] == sum(soil_of(site).water_stress(x2) < 1 for x2 in volumes) == 3
    assert "evapotranspiration_ratio" not in metrics.results()  # there was no demand


def hourly(site: Site, hours: int, **amounts: dict[int, float]) -> Ticks:
    """Return ticks of hours with these amounts of rain, pumping and drainage (m3)."""
    def rate(name: str, hour: int) -> float:
        return amounts.get(name, {}).get(hour, 0.0) / 3600

    ticks_per_hour = round(3600 / site.tau)
    return [
        (50.0, 1.0, 0.0, rate("rain", hour) / site.a2, STILL._replace(
            pump=rate("pumped", hour), drainage=rate("drained", hour)
        ))
        for hour in (k // ticks_per_hour for k in range(hours * ticks_per_hour + 1))
    ]


def test_rain_kept_by_hand() -> None:
    """Three days on 100 m2: 30 mm in an hour, 4 mm a day later, and 6 and 5 mm the day after.

    - Hour 10: 3 m3 fall, 0.6 drain in the hour and 0.9 in the next.
    - Hour 35: this drainage follows nothing that came within six hours.
    - Hour 36: 0.4 m3 fall, 0.1 drain.
    - Hour 41: 0.6 m3 are pumped, 0.5 drain: 0.4 of it, 0.2 m3, comes from the rain of hour 36.
    - Hour 60: 0.6 m3 fall, as much as was pumped in hour 55: half of the 0.2 drained is rain.
    - Hour 61: 0.5 m3 fall.

    Of 4.5 m3 of rain 1.9 drain. Hours 0 to 33 and 38 to 71 are in 24 h with more than 10 mm: of
    4.1 m3 in these 1.8 drain.
    """
    site = site_with(a2=100.0, tau=600.0)
    results = metrics_of(site, hourly(
        site, 72, rain={10: 3.0, 36: 0.4, 60: 0.6, 61: 0.5}, pumped={41: 0.6, 55: 0.6},
        drained={10: 0.6, 11: 0.9, 35: 0.3, 36: 0.1, 41: 0.5, 60: 0.2},
    ))
    assert results["rain_kept_share"] == pytest.approx(1 - 1.9 / 4.5, rel=1e-9)
    assert results["rain_kept_share_hour"] == pytest.approx(0.8, rel=1e-9)
    assert results["rain_kept_share_day"] == pytest.approx(1 - 1.8 / 4.1, rel=1e-9)


@pytest.mark.parametrize(("depth", "expected"), [(20.0, False), (20.1, True)])
def test_a_storm_has_more(depth: float, expected: bool) -> None:
    """An hour with 20 mm is not a storm; with more it is, and if more drains, nothing is kept."""
    site = site_with(a2=100.0, tau=0.1)
    results = metrics_of(site, hourly(site, 2, rain={1: depth / 10}, drained={1: 5.0})).results()
    assert results.get("rain_kept_share_hour") == (0.0 if expected else None)


def test_every_bit_regardless_of_the_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four days of 5 min with storms of ten hours; in blocks of 1, 7 and 1000 ticks."""
    site, results = site_with(tau=300.0, starts_per_hour=3.0), []
    ticks = [
        (x1, x2, command, 3 * rain * (k // 120 % 3 == 0), flows)
        for k, (x1, x2, command, rain, flows) in enumerate(drawn(4 * 288 + 1, seed=1))
    ]
    for size in (1, 7, 1000):
        monkeypatch.setattr(metrics_module, "_BLOCK_BYTES", size * 8 * len(metrics_module.TICK))
        metrics = metrics_of(site, ticks)
        results.append((metrics.results(), metrics.weekly_deviations()))
        assert results[-1] == (metrics.results(), metrics.weekly_deviations())
    assert results[0] == results[1] == results[2]
    assert all(0 < results[0][0][name] < 1 for name in KEPT)


def test_a_long_run_is_not_copied(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is set aside counts: the same bits of every metric and event, however little is kept."""
    site = site_with(tau=60.0)
    ticks = [
        (x1, x2, command, rain * (k % 700 < 90), flows)
        for k, (x1, x2, command, rain, flows) in enumerate(drawn(2001, seed=3))
    ]
    results = []
    for many, ticks_each in ((4096, 4096), (1, 1), (5, 7), (100, 64)):
        monkeypatch.setattr(metrics_module, "_MANY", many)
        size = ticks_each * 8 * len(metrics_module.TICK)
        monkeypatch.setattr(metrics_module, "_BLOCK_BYTES", size)
        metrics = metrics_of(site, ticks)
        results.append((metrics.results(), metrics.events(), metrics.weekly_deviations()))
    assert results[0][1] and all(result == results[0] for result in results)
