"""The water account, compared with the summaries of runs and with sums by hand."""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pytest
from page_inputs import SECOND, START
from paper import PAPER_SITE, paper_run, site_file
from places import CONFIG

from greenroof_ros.experiment.closed_loop import closed_loop, record
from greenroof_ros.model.metrics import Metrics
from greenroof_ros.model.plant import Plant
from greenroof_ros.model.site import Site, edited
from greenroof_ros.watch.account import TOPICS, Account

# Entry of the account: key of summary.json.
SUMMED = {
    "rain": "rain_roof_m3", "pumped": "pumped_m3", "drained": "drainage_m3",
    "evapotranspired": "evapotranspiration_m3", "overflow": "outflow_m3",
    "inflow": "rain_cistern_m3", "energy": "electric_energy_kwh",
    "evapotranspiration_ratio": "evapotranspiration_ratio", "kept": "rain_kept_share",
    "kept_day": "rain_kept_share_day",
}
# The account does not count the tick in which a run ends.
OVER_TICKS = {"stress": "stress_hours", "deviation": "mean_deviation_mm"}
STORM = ("--start", "2021-07-08T12:00-05:00", "--cistern", "75.5", "--roof", "34.39")
MEASURED = CONFIG / "site_neubrandenburg.yaml"
# A storm on a full roof next to a full cistern; a roof with nothing to evaporate; half an hour of
# rain on a measured soil, with a drainage layer that is treated as storage and drains at first, and
# dry plants; a low outlet, through which the detention volume drains.
RUNS = {
    "storm": ("--hours", "0.5", *STORM),
    "empty": ("--hours", "0.2", "--start", "2021-07-07T14:00-05:00", "--cistern", "10",
              "--roof", "0"),
    "measured": ("--hours", "0.5", "--fraction", "0.02", "--cistern", "57.7", "--roof", "1.7",
                 "--start", "2021-07-08T05:00-05:00"),
    "low outlet": ("--hours", "0.5", *STORM[:2]),
}

Recorded = dict[str, tuple[np.ndarray, np.ndarray]]


@dataclass
class Simulated:
    """A run: its values by topic as in a graph, its metrics, and its site."""

    topics: Recorded
    summary: dict[str, float]
    site: Site

    def account(self, *, live: bool = False) -> Account:
        """Return its account; a live site has no topics for drainage and outflow."""
        topics = TOPICS[:5] if live else TOPICS
        return filled({topic: self.topics[topic] for topic in topics}, self.site, live=live)


def simulated(*options: str) -> Simulated:
    run = paper_run("--controller", "onoff", *options)
    site, metrics = run.site, Metrics()
    happened = record(run, closed_loop(run, run.make_controller(), metrics))
    times = START + SECOND * np.arange(len(happened.time))
    values = (
        happened.roof / site.a2, happened.cistern / site.a1, happened.precipitation,
        happened.evapotranspiration, happened.pump_flow, happened.outflow, happened.drainage,
    )
    topics = {topic: (times, column) for topic, column in zip(TOPICS, values, strict=True)}
    return Simulated(topics, metrics.results(), site)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Simulated]:
    place = tmp_path_factory.mktemp("sites")
    measured = place / "measured.yaml"
    measured.write_text(f"{edited(MEASURED, {})}initial_layer: 0.3\n", encoding="utf-8")
    outlet = site_file(
        place, runoff_coefficient=0.8, low_outlet_level=1.0, low_outlet_radius=0.05
    )
    sites = {"measured": measured, "low outlet": outlet}
    return {
        name: simulated(*options, *(("--site", str(sites[name])) if name in sites else ()))
        for name, options in RUNS.items()
    }


def assert_equal(totals: Mapping[str, float], summary: Mapping[str, float]) -> None:
    for key, name in SUMMED.items():
        assert totals.get(key) == pytest.approx(summary.get(name), rel=0, abs=1e-9), key
    for key, name in OVER_TICKS.items():
        assert totals[key] == pytest.approx(summary[name], rel=1e-3, abs=1.01 / 3600), key


@pytest.mark.parametrize("name", RUNS)
def test_batches_give_the_summary(runs: dict[str, Simulated], name: str) -> None:
    """Batches come topic by topic, and the totals may be read between any two of them."""
    run, chance = runs[name], random.Random(7)
    account = Account(run.site)
    count, first = len(run.topics["/roof/level"][0]), 0
    while first < count:
        last = first + chance.choice([1, 2, 31, 700])
        order = list(run.topics)
        chance.shuffle(order)
        for topic in order:
            times, values = run.topics[topic]
            account.add(topic, times[first:last], values[first:last])
            account.totals()
        first = last
    totals = account.totals()
    assert_equal(totals, run.summary)
    assert account.gap_s == 0
    assert account.measured
    assert (account.since, account.until) == (START, START + (count - 1) * SECOND)
    # The plant is exact: the unexplained rest is only rounding.
    assert abs(totals["unexplained"]) < 1e-9


@pytest.mark.parametrize(("name", "keys"), [
    ("storm", ("drained", "overflow")), ("measured", ("drained", "evapotranspired")),
    ("low outlet", ("overflow",)),
])
def test_a_live_site_has_the_same_computed_from_its_levels(
    runs: dict[str, Simulated], name: str, keys: tuple[str, ...]
) -> None:
    account = runs[name].account(live=True)
    totals, known = account.totals(), runs[name].account().totals()
    assert not account.measured
    for key in keys:
        assert totals[key] == pytest.approx(known[key], rel=1e-9), key


def test_the_runs_reach_what_they_are_for(runs: dict[str, Simulated]) -> None:
    """Otherwise a wrong limit, drainage or overflow would go unnoticed above."""
    summaries = {name: run.summary for name, run in runs.items()}
    assert summaries["storm"]["drainage_m3"] > 1e-3
    assert summaries["storm"]["outflow_m3"] > 0.1
    assert summaries["empty"]["limited_steps"] > 10
    assert summaries["measured"]["drainage_m3"] > 0.1
    assert summaries["measured"]["final_layer_m3"] > 0.001
    asked = runs["measured"].topics["/weather/evapotranspiration"][1][:-1].sum()
    assert 0 < summaries["measured"]["evapotranspiration_m3"] < 0.9 * asked
    assert summaries["low outlet"]["outflow_m3"] > 10


def test_a_driver_that_reports_more_than_the_cistern_gave() -> None:
    """In a simulation with a pump driver the plant's own flow counts, as in its summary."""
    plant, metrics = Plant(PAPER_SITE, 0.25, 1.0), Metrics()
    rows = []
    for _ in range(101):
        flows = plant.flows(1e-7, 1e-6, 0.01)
        metrics.observe(PAPER_SITE, plant.x1, plant.x2)
        rows.append((plant.x2 / 68.8, plant.x1 / 25, 1e-7, 1e-6, 0.01, *flows[0:3:2]))
        if len(rows) <= 100:
            metrics.step(0.5, 1e-7, 1e-6, flows)
            plant.step(1e-7, flows)
    times = START + SECOND * np.arange(101)
    account = filled({
        topic: (times, np.array(column))
        for topic, column in zip(TOPICS, zip(*rows, strict=True), strict=True)
    })
    assert_equal(account.totals(), metrics.results())
    assert account.totals()["pumped"] < 0.26


def steady(ticks: int, **rates: float) -> Recorded:
    """Return topics of a run in which the same happens in each tick."""
    times = START + SECOND * np.arange(ticks)
    given = {"/roof/level": 0.03, "/cistern/level": 2.0, **rates}
    return {topic: (times, np.full(ticks, given.get(topic, 0.0))) for topic in TOPICS}


def filled(topics: Recorded, site: Site = PAPER_SITE, *, live: bool = False) -> Account:
    account = Account(site)
    account.live = live
    for topic, (times, values) in topics.items():
        account.add(topic, times, values)
    return account


def test_a_tick_that_was_not_responding_is_a_gap_and_what_was_refused_acted_as_nothing() -> None:
    """An implausible value is NaN here; in a simulation that is not a gap."""
    topics = steady(101, **{"/pump/flow": 1e-3, "/weather/precipitation": 1e-6})
    topics["/weather/precipitation"][1][50:60] = np.nan
    for topic, ticks in (*((topic, 10) for topic in TOPICS), ("/pump/flow", [39, 40])):
        times, values = topics[topic]
        topics[topic] = np.delete(times, ticks), np.delete(values, ticks)
    account = filled(topics)
    totals = account.totals()
    assert totals["pumped"] == pytest.approx(97 * 1e-3, rel=1e-12)
    assert totals["rain"] == pytest.approx(89 * 1e-6 * 68.8, rel=1e-12)
    assert account.gap_s == 3


def live_topics() -> Recorded:
    """Topics of a live site for an hour, each at its own times; drainage is not published."""
    def at(*seconds: float) -> np.ndarray:
        return START + np.round(np.array(seconds) * SECOND).astype(np.int64)

    return {
        "/roof/level": (at(*np.arange(0, 3601, 5)), np.full(721, 0.03)),
        "/cistern/level": (at(0.4, *np.arange(4, 3601, 4)), np.full(901, 2.0)),
        "/weather/precipitation": (at(*np.arange(0, 3601, 1)), np.full(3601, 1e-6)),
        "/weather/evapotranspiration": (at(*np.arange(0, 3601, 1)), np.full(3601, 1e-5)),
        # Silent for 27 minutes; only 10 count.
        "/pump/flow": (at(0, 600, 1200, 1500, 1620, 3240, 3600), np.full(7, 1e-3)),
    }


def test_a_live_value_holds_for_ten_minutes_and_a_refused_one_is_unknown() -> None:
    """From 0.4 s, when the last topic first came, to 3600 s, except 1620 + 600 to 3240 s."""
    account = filled(live_topics(), live=True)
    totals = account.totals()
    assert account.since == START + 400_000_000
    assert account.until == START + 3600 * SECOND
    assert account.gap_s == pytest.approx(1020, rel=1e-12)
    assert totals["pumped"] == pytest.approx(1e-3 * (3599.6 - 1020), rel=1e-12)
    assert totals["rain"] == pytest.approx(1e-6 * 68.8 * 3599.6, rel=1e-12)
    assert totals["stored"] == totals["drained"] == totals["overflow"] == 0
    flows = 1e-3 * 2579.6 + (1e-6 * 68.8 - 1e-5) * 3599.6
    assert totals["unexplained"] == pytest.approx(-flows, rel=1e-12)
    topics = live_topics()
    topics["/weather/precipitation"][1][100:200] = np.nan
    account = filled(topics, live=True)
    assert account.totals()["rain"] == pytest.approx(1e-6 * 68.8 * 3499.6, rel=1e-12)
    assert account.gap_s == pytest.approx(1120, rel=1e-12)


def test_flows_are_summed_up_to_the_last_level() -> None:
    """A level that comes every 5 s shows all of a steady flow, at any time."""
    topics = live_topics()
    times = START + SECOND * np.arange(3601)
    for topic in TOPICS[2:5]:
        topics[topic] = times, np.full(3601, 8e-3 if topic == "/pump/flow" else 0.0)
    at = topics["/roof/level"][0]
    topics["/roof/level"] = at, 0.03 + 8e-3 * (at - START) / SECOND / PAPER_SITE.a2
    for second in (3006, 3007, 3009, 3010):
        until = START + second * SECOND
        account = filled({
            topic: (times[times <= until], values[times <= until])
            for topic, (times, values) in topics.items() if topic in TOPICS[:5]
        }, live=True)
        totals = account.totals()
        # From 0.4 s on, when the last topic was first received; the level then is of 0 s.
        assert totals["unexplained"] == pytest.approx(0.4 * 8e-3, rel=1e-6), second


def test_a_topic_that_falls_silent_stops_the_account_for_ten_minutes_only() -> None:
    """The flow comes last at 100 s, and holds until 700 s; then the account no longer waits."""
    account = Account(PAPER_SITE)
    account.live = True
    for second in range(0, 3600, 20):
        for topic in TOPICS[:5]:
            if topic != "/pump/flow" or second <= 100:
                time = np.array([START + second * SECOND])
                account.add(topic, time, np.full(1, 1e-3))
        account.totals()
        if second == 400:
            assert account.until == START + 100 * SECOND
    totals = account.totals()
    assert account.until == START + 3580 * SECOND
    assert totals["pumped"] == pytest.approx(1e-3 * 700, rel=1e-12)
    assert account.gap_s == pytest.approx(3580 - 700)


def test_what_was_never_heard_is_unknown_and_not_nothing() -> None:
    topics = live_topics()
    del topics["/weather/evapotranspiration"]
    account = filled(topics, live=True)
    account.end()
    totals = account.totals()
    assert "evapotranspired" not in totals
    assert "unexplained" not in totals
    assert totals["rain"] == pytest.approx(1e-6 * 68.8 * 3599.6, rel=1e-12)
    assert account.gap_s == pytest.approx(3599.6)


def test_memory_is_bounded_while_no_one_looks() -> None:
    """Half a million values: those already counted are dropped."""
    account = Account(PAPER_SITE)
    topics = steady(1000)
    for block in range(70):
        for topic, (times, values) in topics.items():
            account.add(topic, times + block * 1000 * SECOND, values)
    assert sum(len(pending.times) for pending in account._topics.values()) < 300_000
    assert account.totals()["pumped"] == 0
    assert sum(len(pending.times) for pending in account._topics.values()) == len(TOPICS)
