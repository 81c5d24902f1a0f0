"""The water account, against the summaries of runs and against sums by hand."""

from __future__ import annotations

import random
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from graphs import bag_file, bring_up
from mcap.reader import make_reader
from paper import PAPER_SITE, paper_run, site_file
from places import CONFIG

from greenroof_ros.experiment.closed_loop import closed_loop, record
from greenroof_ros.model.metrics import Metrics
from greenroof_ros.model.plant import Plant
from greenroof_ros.model.site import Site, edited
from greenroof_ros.recording.trajectory import Trajectory
from greenroof_ros.watch.account import TOPICS, Account

SECOND = 10**9
START = 1_626_757_200 * SECOND
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
# A dry day; a storm on a full roof beside a full cistern; a roof with nothing to evaporate.
MEASURED = (
    "--hours", "0.5", "--controller", "onoff", "--fraction", "0.02", "--cistern", "57.7",
    "--roof", "1.7", "--start", "2021-07-08T05:00-05:00",
    "--site", str(CONFIG / "site_neubrandenburg.yaml"),
)
RUNS = {
    "dry": ("--hours", "0.5", "--controller", "onoff"),
    "storm": ("--hours", "0.5", "--controller", "onoff", *STORM),
    "empty": ("--hours", "0.2", "--controller", "onoff", "--start", "2021-07-07T14:00-05:00",
              "--cistern", "10", "--roof", "0"),
}

Recorded = dict[str, tuple[np.ndarray, np.ndarray]]


def recorded(run: Trajectory, site: Site) -> Recorded:
    """Return what a graph publishes of a run, by topic."""
    times = START + SECOND * np.arange(len(run.time))
    values = (
        run.roof / site.a2, run.cistern / site.a1, run.precipitation, run.evapotranspiration,
        run.pump_flow, run.outflow, run.drainage,
    )
    return {topic: (times, column) for topic, column in zip(TOPICS, values, strict=True)}


@pytest.fixture(scope="module", params=RUNS)
def simulated(request: pytest.FixtureRequest) -> tuple[Recorded, dict[str, float]]:
    """A run's topics, and its metrics."""
    run = paper_run(*RUNS[request.param])
    metrics = Metrics()
    happened = record(run, closed_loop(run, run.make_controller(), metrics))
    return recorded(happened, run.site), metrics.results()


def assert_equal(totals: Mapping[str, float], summary: Mapping[str, float]) -> None:
    for key, name in SUMMED.items():
        assert totals.get(key) == pytest.approx(summary.get(name), rel=0, abs=1e-9), key
    for key, name in OVER_TICKS.items():
        assert totals[key] == pytest.approx(summary[name], rel=1e-3, abs=1.01 / 3600), key


def test_batches_give_the_summary(simulated: tuple[Recorded, dict[str, float]]) -> None:
    """Batches come topic by topic, and somebody may look between any two of them."""
    topics, summary = simulated
    account = Account(PAPER_SITE)
    chance = random.Random(7)
    count, first = len(topics["/roof/level"][0]), 0
    while first < count:
        last = first + chance.choice([1, 2, 31, 700])
        order = list(topics)
        chance.shuffle(order)
        for topic in order:
            times, values = topics[topic]
            account.add(topic, times[first:last], values[first:last])
            account.totals()
        first = last
    totals = account.totals()
    assert_equal(totals, summary)
    assert account.gap_s == 0
    assert account.measured
    assert (account.since, account.until) == (START, START + (count - 1) * SECOND)
    # The plant is exact: nothing is left unexplained but rounding.
    assert abs(totals["unexplained"]) < 1e-9


def test_a_measured_roof_gives_the_summary() -> None:
    """Half an hour of rain: its drainage layer is a part of what is stored, its plants are dry.

    A live site, where nobody says the drainage, gives the same; it is computed from the level.
    """
    run = paper_run(*MEASURED)
    metrics = Metrics()
    happened = record(run, closed_loop(run, run.make_controller(), metrics))
    summary = metrics.results()
    topics = recorded(happened, run.site)
    account = Account(run.site)
    for topic, (times, values) in topics.items():
        account.add(topic, times, values)
    totals = account.totals()
    assert_equal(totals, summary)
    assert abs(totals["unexplained"]) < 1e-9
    assert summary["drainage_m3"] > 0.001
    assert summary["final_layer_m3"] > 0.001
    asked = run.site.tau * happened.evapotranspiration[:-1].sum()
    assert 0 < totals["evapotranspired"] < 0.9 * asked

    live = Account(run.site)
    live.live = True
    for topic in TOPICS[:5]:
        live.add(topic, *topics[topic])
    found = live.totals()
    assert not live.measured
    for key in ("drained", "evapotranspired"):
        assert found[key] == pytest.approx(totals[key], rel=1e-9), key


def test_water_in_the_layer_at_first_gives_the_summary(tmp_path: Path) -> None:
    """It drains off, and what is stored falls by it."""
    measured = edited(CONFIG / "site_neubrandenburg.yaml", {})
    file = tmp_path / "site.yaml"
    file.write_text(f"{measured}initial_layer: 0.3\n", encoding="utf-8")
    run = paper_run("--controller", "onoff", "--hours", "0.5", "--site", str(file))
    metrics = Metrics()
    happened = record(run, closed_loop(run, run.make_controller(), metrics))
    account = Account(run.site)
    for topic, (times, values) in recorded(happened, run.site).items():
        account.add(topic, times, values)
    assert_equal(account.totals(), metrics.results())
    assert account.totals()["drained"] > 0.1
    assert abs(account.totals()["unexplained"]) < 1e-9


def test_a_low_outlet_gives_the_summary(tmp_path: Path) -> None:
    """Half an hour in which the detention volume drains; a live site computes the same from it."""
    file = site_file(tmp_path, runoff_coefficient=0.8, low_outlet_level=1.0, low_outlet_radius=0.05)
    run = paper_run(*STORM[:2], "--hours", "0.5", "--controller", "onoff", "--site", str(file))
    metrics = Metrics()
    happened = record(run, closed_loop(run, run.make_controller(), metrics))
    topics = recorded(happened, run.site)
    account, live = Account(run.site), Account(run.site)
    live.live = True
    for topic, (times, values) in topics.items():
        account.add(topic, times, values)
        if topic in TOPICS[:5]:
            live.add(topic, times, values)
    assert_equal(account.totals(), metrics.results())
    assert account.totals()["overflow"] > 10
    assert not live.measured
    assert live.totals()["overflow"] == pytest.approx(account.totals()["overflow"], rel=1e-9)


def test_heard_one_by_one_gives_the_same_bits(
    simulated: tuple[Recorded, dict[str, float]]
) -> None:
    topics, _ = simulated
    at_once, one_by_one = Account(PAPER_SITE), Account(PAPER_SITE)
    for topic, (times, values) in topics.items():
        at_once.add(topic, times, values)
    for tick in range(len(topics["/roof/level"][0])):
        for topic, (times, values) in topics.items():
            one_by_one.add(topic, times[tick : tick + 1], values[tick : tick + 1])
        if tick % 50 == 0:
            one_by_one.totals()
    assert one_by_one.totals() == at_once.totals()


def test_the_runs_reach_what_they_are_for() -> None:
    """Without these a wrong limit, drainage or overflow would not be seen above."""
    found = {}
    for name in ("storm", "empty"):
        run = paper_run(*RUNS[name])
        metrics = Metrics()
        for _ in closed_loop(run, run.make_controller(), metrics):
            pass
        found[name] = metrics.results()
    assert found["storm"]["drainage_m3"] > 1e-3
    assert found["storm"]["outflow_m3"] > 0.1
    assert found["empty"]["limited_steps"] > 10


def test_a_driver_that_says_more_than_the_cistern_gave() -> None:
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


def filled(topics: Recorded, *, live: bool = False) -> Account:
    account = Account(PAPER_SITE)
    account.live = live
    for topic, (times, values) in topics.items():
        account.add(topic, times, values)
    return account


def without(topics: Recorded, topic: str, *ticks: int) -> Recorded:
    times, values = topics[topic]
    return {**topics, topic: (np.delete(times, ticks), np.delete(values, ticks))}


def test_a_tick_that_was_not_heard_is_a_gap() -> None:
    """Of 101 ticks two flows are missing: 98 of 100 s are known; the rain is known throughout."""
    topics = steady(101, **{"/pump/flow": 1e-3, "/weather/precipitation": 1e-6})
    account = filled(without(topics, "/pump/flow", 40, 41))
    totals = account.totals()
    assert totals["pumped"] == pytest.approx(0.098, rel=1e-12)
    assert totals["rain"] == pytest.approx(100 * 1e-6 * 68.8, rel=1e-12)
    assert account.gap_s == 2


def test_a_tick_of_which_nothing_was_heard_is_a_gap() -> None:
    topics = steady(101, **{"/pump/flow": 1e-3})
    for topic in TOPICS:
        topics = without(topics, topic, 10)
    account = filled(topics)
    assert account.totals()["pumped"] == pytest.approx(0.099, rel=1e-12)
    assert account.gap_s == 1


def test_what_the_plant_refused_acted_as_nothing() -> None:
    """A value that is not plausible comes here as NaN; in a simulation that is no gap."""
    topics = steady(101, **{"/weather/precipitation": 1e-6})
    topics["/weather/precipitation"][1][:50] = np.nan
    account = filled(topics)
    assert account.totals()["rain"] == pytest.approx(50 * 1e-6 * 68.8, rel=1e-12)
    assert account.gap_s == 0


def live_topics() -> Recorded:
    """Topics of a live site, each at its own times, for an hour; nobody says what drains."""
    def at(*seconds: float) -> np.ndarray:
        return START + np.round(np.array(seconds) * SECOND).astype(np.int64)

    return {
        "/roof/level": (at(*np.arange(0, 3601, 5)), np.full(721, 0.03)),
        "/cistern/level": (at(0.4, *np.arange(4, 3601, 4)), np.full(901, 2.0)),
        "/weather/precipitation": (at(*np.arange(0, 3601, 1)), np.full(3601, 1e-6)),
        "/weather/evapotranspiration": (at(*np.arange(0, 3601, 1)), np.full(3601, 1e-5)),
        # Silent for 27 minutes, of which 10 count.
        "/pump/flow": (at(0, 600, 1200, 1500, 1620, 3240, 3600), np.full(7, 1e-3)),
    }


def test_a_live_value_holds_for_ten_minutes() -> None:
    """From 0.4 s, when the last topic was first heard, to 3600 s, but for 1620 + 600 to 3240 s."""
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


def test_a_refused_live_value_is_unknown() -> None:
    topics = live_topics()
    topics["/weather/precipitation"][1][100:200] = np.nan
    account = filled(topics, live=True)
    assert account.totals()["rain"] == pytest.approx(1e-6 * 68.8 * 3499.6, rel=1e-12)
    assert account.gap_s == pytest.approx(1120, rel=1e-12)


def test_live_drainage_and_overflow_follow_from_the_levels() -> None:
    """Eq. (4) at 0.6 m: K a2 (0.6 + 0.5) / 0.5; Eq. (2) at 3.25 m: c_d r_o^2 pi sqrt(2 g 0.25)."""
    topics = live_topics()
    topics["/roof/level"][1][:] = 0.6
    topics["/cistern/level"][1][:] = 3.25
    account = filled(topics, live=True)
    totals = account.totals()
    assert not account.measured
    assert totals["drained"] == pytest.approx(7.83e-8 * 68.8 * 2.2 * 3599.6, rel=1e-9)
    outflow = 0.61 * np.pi * 0.125**2 * (2 * 9.81 * 0.25) ** 0.5
    assert totals["overflow"] == pytest.approx(outflow * 3599.6, rel=1e-9)


def test_a_topic_that_falls_silent_stops_the_account_for_ten_minutes_only() -> None:
    """The flow is heard last at 100 s, and holds to 700 s; nobody waits for it any longer then."""
    account = Account(PAPER_SITE)
    account.live = True
    for second in range(0, 3600, 10):
        for topic in TOPICS[:5]:
            if topic != "/pump/flow" or second <= 100:
                time = np.array([START + second * SECOND])
                account.add(topic, time, np.full(1, 1e-3))
        account.totals()
        if second == 400:
            assert account.until == START + 100 * SECOND
    totals = account.totals()
    assert account.until == START + 3590 * SECOND
    assert totals["pumped"] == pytest.approx(1e-3 * 700, rel=1e-12)
    assert account.gap_s == pytest.approx(3590 - 700)


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


def test_memory_is_bounded_while_nobody_looks() -> None:
    """A million values: what is counted is let go of."""
    account = Account(PAPER_SITE)
    topics = steady(1000)
    for block in range(150):
        for topic, (times, values) in topics.items():
            account.add(topic, times + block * 1000 * SECOND, values)
    kept = sum(len(pending.all()[0]) for pending in account._topics.values())
    assert kept < 300_000
    assert account.totals()["pumped"] == 0
    assert sum(len(pending.all()[0]) for pending in account._topics.values()) == len(TOPICS)


def test_the_bag_of_a_graph_gives_its_summary(domain: int, tmp_path: Path) -> None:
    """Read from the bag's own bytes, against what the plant of that run counted."""
    pytest.importorskip("rclpy", reason="the graph needs ROS 2")
    summary = bring_up(domain, tmp_path, "--controller", "onoff", "--hours", "0.1", *STORM)
    found: dict[str, list[tuple[int, float]]] = {}
    with bag_file(tmp_path / "run").open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages(topics=TOPICS):
            (value,) = struct.unpack("<d", message.data[4:12])
            found.setdefault(channel.topic, []).append((message.log_time, value))
    account = Account(PAPER_SITE)
    for topic, rows in found.items():
        times, values = zip(*rows, strict=True)
        account.add(topic, np.array(times), np.array(values))
    totals = account.totals()
    assert len(found) == len(TOPICS)
    assert totals["overflow"] > 0.1
    assert_equal(totals, summary)
    assert account.gap_s == 0
