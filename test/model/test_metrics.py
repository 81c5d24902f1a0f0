"""Metrics, against sums that are made tick by tick in plain Python: equal in every bit."""

from __future__ import annotations

import random
from dataclasses import fields, replace
from pathlib import Path

import pytest
from paper import PAPER_SITE, site_with
from places import CONFIG

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.metrics import METRICS, Metrics
from greenroof_ros.model.plant import Flows
from greenroof_ros.model.site import Site, read_site, site_parameters

COUNTS = {"limited_steps", "pump_starts", "busiest_hour_starts", "excess_starts"}
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
            ),
        )
        for _ in range(count)
    ]


def sums(site: Site, ticks: Ticks) -> dict[str, float]:
    """Return the metrics of ticks, of which the last is the end of the run."""
    # The paper's site has no drainage layer and no mains.
    absent = {"final_layer_m3", "mains_m3"}
    names = [metric.name for metric in METRICS if metric.name not in absent]
    found: dict[str, float] = {**dict.fromkeys(names, 0.0), **dict.fromkeys(COUNTS, 0)}
    pumping = False
    in_hour: list[float] = []  # when the pumps started in the hour that ends now (s)
    for k, (x1, x2, command, rain, flows) in enumerate(ticks[:-1]):
        if flows.pump > 0 and not pumping:
            now = k * site.tau
            in_hour = [*(start for start in in_hour if start > now - 3600), now]
            found["busiest_hour_starts"] = max(found["busiest_hour_starts"], len(in_hour))
            found["excess_starts"] += len(in_hour) > site.starts_per_hour
        head = site.pipe_resistance * flows.pump**2 + site.d - x1 / site.a1
        energy = 1000.0 * site.g * flows.pump * head * site.tau / 3.6e6
        for name, value in (
            ("total_deviation_m3", abs(x2 - site.x2_star)),
            ("near_target_hours", int(abs(x2 - site.x2_star) <= 0.05 * site.x2_star)),
            ("saved_m3", site.tau * flows.pump),
            ("pumped_m3", site.tau * flows.pump),
            ("outflow_m3", site.tau * flows.outflow),
            ("drainage_m3", site.tau * flows.drainage),
            ("rain_m3", site.tau * rain * (site.a_in + site.a2)),
            ("rain_cistern_m3", site.tau * rain * site.a_in),
            ("rain_roof_m3", site.tau * rain * site.a2),
            ("evapotranspiration_m3", site.tau * flows.evapotranspiration),
            ("beyond_hours", int(command > 1)),
            ("limited_steps", int(flows.limited)),
            ("pump_starts", int(flows.pump > 0 and not pumping)),
            ("pump_hours", int(flows.pump > 0)),
            ("hydraulic_energy_kwh", energy),
            ("electric_energy_kwh", energy / site.pump_efficiency),
        ):
            found[name] += value
        found["max_command"] = max(found["max_command"], command)
        pumping = flows.pump > 0
    found["final_cistern_m3"], found["final_roof_m3"] = ticks[-1][:2]
    found["total_deviation_m3"] += abs(ticks[-1][1] - site.x2_star)
    found["near_target_hours"] += abs(ticks[-1][1] - site.x2_star) <= 0.05 * site.x2_star
    # Exact, as a sum of 1 / 3600 is not.
    for name in ("beyond_hours", "pump_hours", "near_target_hours"):
        found[name] = found[name] * site.tau / 3600
    return found


@pytest.mark.parametrize(("days", "weeks"), [(1, 1), (14, 2), (34, 5)])
def test_weeks(days: int, weeks: int) -> None:
    """Each week's deviation by hand, across blocks; the last tick counts in the last."""
    site = replace(PAPER_SITE, tau=600.0)
    ticks = drawn(days * 144 + 1, seed=days)
    metrics = Metrics()
    for x1, x2, command, rain, flows in ticks[:-1]:
        metrics.observe(site, x1, x2)
        metrics.step(command, rain, flows)
    metrics.observe(site, *ticks[-1][:2])
    expected = [0.0] * weeks
    for k, tick in enumerate(ticks):
        expected[min(k // 1008, weeks - 1)] += abs(tick[1] - site.x2_star)
    found = metrics.weekly_deviations()
    assert found == pytest.approx(expected, rel=1e-12)
    assert sum(found) == pytest.approx(metrics["total_deviation_m3"], rel=1e-12)


@pytest.mark.parametrize("count", [1, 2, 4096, 4097, 4098, 10_000])
def test_every_bit_whatever_the_length(count: int) -> None:
    """Of runs that are shorter than a block, as long, and longer; half way, and at the end."""
    site = site_with(tau=0.5, g=9.8, starts_per_hour=700.0)
    ticks = drawn(count, seed=count)
    metrics = Metrics()
    for tick, (x1, x2, command, rain, flows) in enumerate(ticks, start=1):
        metrics.observe(site, x1, x2)
        if tick == count // 2:
            assert metrics.results() == sums(site, ticks[:tick])
        if tick < count:
            metrics.step(command, rain, flows)
    found = metrics.results()
    assert found == sums(site, ticks)
    assert found == metrics.results()
    assert {name for name, value in found.items() if type(value) is int} == COUNTS


@pytest.mark.parametrize(
    ("tau", "gap", "busiest"), [(0.1, 1800, 20), (0.1, 1799, 21), (1.0, 180, 20)]
)
def test_an_hour_holds_its_first_start_no_more(tau: float, gap: int, busiest: int) -> None:
    """Twenty starts 180 s apart fill it; the next comes as the first leaves it."""
    site = site_with(tau=tau)
    metrics = Metrics()
    for tick in range(30 * gap):
        metrics.observe(site, 75.0, 1.0)
        metrics.step(1.0, 0.0, Flows(0.0, 0.004 * (tick % gap == 0), 0.0, 0.0, False))
    assert metrics["pump_starts"] == 30
    assert metrics["busiest_hour_starts"] == busiest
    assert metrics["excess_starts"] == (10 if busiest > 20 else 0)


def test_electric_energy_is_over_the_sites_efficiency(tmp_path: Path) -> None:
    """A half unless the site file says otherwise."""
    text = (CONFIG / "site.yaml").read_text()
    [line] = [line for line in text.splitlines() if line.startswith("pump_efficiency")]
    file = tmp_path / "site.yaml"
    for new, efficiency in ((line, 0.5), ("", 0.5), ("pump_efficiency: 0.25", 0.25)):
        file.write_text(text.replace(line, new))
        metrics = Metrics()
        site = read_site(file)
        metrics.observe(site, 75.0, 1.0)
        metrics.step(1.0, 0.0, Flows(0.0, 0.004, 0.0, 0.0, False))
        hydraulic = metrics["hydraulic_energy_kwh"]
        assert hydraulic > 0
        assert metrics["electric_energy_kwh"] == hydraulic / efficiency
    for wrong in ("0", "1.01", "-0.5", "50"):
        file.write_text(text.replace(line, f"pump_efficiency: {wrong}"))
        with pytest.raises(ConfigurationError, match=r"pump_efficiency.*must be from 0.001 to 1"):
            read_site(file)


def test_mains_water_by_hand() -> None:
    """Five ticks of 2 s, of which the valve of 0.001 m3/s is open in the first three; then the end.

    The run ends below the valve's level of 1 m, 25 m3: there nothing flows any more.
    """
    site = site_with(tau=2.0, mains_level=1.0, mains_flow=0.001)
    metrics = Metrics()
    for x1 in (24.0, 20.0, 24.999, 25.0, 60.0):
        metrics.observe(site, x1, 1.0)
        metrics.step(0.0, 0.0, Flows(0.0, 0.0, 0.0, 0.0, False))
    metrics.observe(site, 24.0, 1.0)
    assert metrics["mains_m3"] == pytest.approx(0.006, rel=1e-12)


def test_each_has_its_words() -> None:
    """Metrics and site parameters: a name of its own, a unit and a meaning."""
    assert len({metric.name for metric in METRICS}) == len(METRICS)
    assert len({metric.label for metric in METRICS}) == len(METRICS)
    assert all(metric.unit and metric.meaning for metric in METRICS)
    assert [one.symbol for one in site_parameters()] == [one.name for one in fields(PAPER_SITE)]
    assert all(one.unit and one.meaning for one in site_parameters())
