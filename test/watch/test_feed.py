"""What a watcher is fed, from real graphs: each value at its tick, whatever the speed."""

from __future__ import annotations

import json
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_topics import MPC_TOPICS
from graphs import Process, bag_file, bring_up, environment, wait_for
from lookers import Peer, in_domain
from mcap.reader import make_reader
from numpy.typing import NDArray

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from greenroof_ros.common.command_line import EXIT_INTERRUPTED
from greenroof_ros.graph.looker import StopFailedError
from greenroof_ros.watch import feed, wire
from greenroof_ros.watch.document import document as read_document
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.store import Store

LEVEL = "/roof/level"
FORECASTS = {"/forecast/precipitation", "/forecast/evapotranspiration"}
HEARD, READ = "graph", "bag"  # the threads that hear and read


class Kept(Store):
    """Keeps what it is fed, besides.

    Attributes:
        values: by the thread and the topic, the value of each time.
        present: what it was told of the graph, each once.
        runs: how often it began anew.
    """

    def __init__(self) -> None:
        self.values: defaultdict[tuple[str, str], dict[int, Any]] = defaultdict(dict)
        self.present: list[tuple[str, str, str]] = []
        self.runs = 0
        super().__init__()

    def _keep(self, topic: str, time_ns: int, value: Any) -> None:
        kept = self.values[threading.current_thread().name, topic]
        assert kept.setdefault(time_ns, value) == value

    def add(self, topic: str, times_ns: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        for time_ns, value in zip(times_ns.tolist(), values.tolist(), strict=True):
            self._keep(topic, time_ns, value)
        super().add(topic, times_ns, values)

    def add_now(self, topic: str, time_ns: int, value: float) -> None:
        self._keep(topic, time_ns, value)
        super().add_now(topic, time_ns, value)

    def add_forecast(
        self, topic: str, time_ns: int, values: NDArray[np.float64], front: NDArray[np.float64]
    ) -> None:
        self._keep(topic, time_ns, values.tolist())
        super().add_forecast(topic, time_ns, values, front)

    def set_present(self, **present: Any) -> None:
        said = tuple(present[key] for key in ("mode", "source", "note"))
        if said not in self.present:
            self.present.append(said)
        super().set_present(**present)

    def begin_anew(self) -> None:
        self.runs += 1
        self.values.clear()
        super().begin_anew()

    def of(self, thread: str) -> dict[str, dict[int, Any]]:
        return {topic: values for (by, topic), values in self.values.items() if by == thread}


@contextmanager
def fed(domain: int, bag: Path | None = None) -> Iterator[tuple[Kept, Feed]]:
    watched = Kept()
    with in_domain(domain), Feed(watched, bag=bag) as feed:
        yield watched, feed


def recorded(run: Path) -> dict[str, dict[int, Any]]:
    """Return each value of a bag at its time."""
    found: defaultdict[str, dict[int, Any]] = defaultdict(dict)
    with bag_file(run).open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            if schema.name.endswith("Float64"):
                found[channel.topic][message.log_time] = wire.number(message.data)
            elif schema.name.endswith("Float64MultiArray"):
                rows = wire.rows(message.data)
                assert rows is not None
                found[channel.topic][message.log_time] = rows[0].tolist()
    return dict(found)


def _shown(watched: Kept) -> dict[str, Any]:
    return read_document(watched, time.monotonic())


def ended(watched: Kept, run: Path) -> None:
    """Wait until the run has ended and its last tick is shown.

    One that was interrupted may have said a tick more than it recorded.
    """
    wait_for(lambda: watched.mode == "ended", 120, "the end of the run")
    last = max(recorded(run)[LEVEL])
    wait_for(lambda: (_shown(watched)["time"]["now"] or 0) >= last / 1e9, 300, "the last tick")


def up_to(last_ns: int, values: dict[int, Any]) -> dict[int, Any]:
    """Return the values of a topic up to the last tick that was recorded; at most one is later."""
    recorded_too = {at: value for at, value in values.items() if at <= last_ns}
    assert len(values) - len(recorded_too) <= 1
    return recorded_too


def check_heard(watched: Kept, run: Path, least: int) -> None:
    """Hold what was heard against the bag: none at another tick; all that was recorded was read."""
    bag, read = recorded(run), watched.of(READ)
    for topic in MPC_TOPICS - {"/clock"} - FORECASTS:
        heard = up_to(max(bag[LEVEL]), watched.of(HEARD)[topic])
        assert heard.items() <= bag[topic].items(), topic
        assert read[topic] == bag[topic], topic
        assert len(heard) > least, topic


def test_what_is_heard_is_the_bags(domain: int, tmp_path: Path) -> None:
    """At 30 times real time: each value at its tick, those before the watcher came too."""
    run = Process(
        domain, "bringup", "--speed", "30", "--hours", "4", "--output", "run", cwd=tmp_path
    )
    wait_for(lambda: bag_file(tmp_path / "run").exists(), 60, "a bag")
    with fed(domain) as (watched, feed):
        # The bag's reader gives way to all others of the machine, and comes first.
        wait_for(lambda: len(watched.of(HEARD).get(LEVEL, ())) > 200, 400, "levels")
        with pytest.raises(StopFailedError, match="no pump node"):
            feed.ask("stop")
        run.process.send_signal(signal.SIGINT)
        assert run.wait(300) == EXIT_INTERRUPTED, run.stderr()
        ended(watched, tmp_path / "run")
        check_heard(watched, tmp_path / "run", 100)
        bag, heard = recorded(tmp_path / "run"), watched.of(HEARD)
    assert set(bag) == set(heard) == MPC_TOPICS - {"/clock"}
    for topic in FORECASTS:
        values = up_to(max(bag[LEVEL]), heard[topic])
        assert all(bag[topic][at] == value for at, value in values.items())
    assert watched.runs == 0


def test_at_full_speed_the_bag_is_read(
    domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """/diagnostics alone is heard; the water account is that of the run's own summary."""
    monkeypatch.setattr(feed, "FASTEST", 3.0)  # a busy machine is slower than 66 at moments
    with fed(domain) as (watched, _):
        first = bring_up(domain, tmp_path, "--hours", "0.25", output="first")
        ended(watched, tmp_path / "first")
        bag, heard = recorded(tmp_path / "first"), watched.of(HEARD)
        # Until the recorder has said where its bag is, samples that came with /diagnostics.
        assert set(heard) <= {LEVEL, "/cistern/level", "/pump/command"}
        assert all(values.items() <= bag[topic].items() for topic, values in heard.items())
        assert watched.of(READ)[LEVEL] == bag[LEVEL]
        rows = read_document(watched, time.monotonic())["account"]["rows"]
        account = {row["key"]: row["number"] for row in rows}
        assert account["pumped"] == pytest.approx(first["pumped_m3"], abs=1e-9)
        assert watched.runs == 0
        # Another run is picked up.
        bring_up(domain, tmp_path, "--hours", "0.15", "--start", "2021-07-08T02:00",
                 output="second")
        ended(watched, tmp_path / "second")
        assert watched.runs >= 1
        assert watched.of(READ)[LEVEL] == recorded(tmp_path / "second")[LEVEL]
    # An ended run is shown from its bag, where no graph is.
    with fed(domain, tmp_path / "first" / "bag") as (watched, _):
        ended(watched, tmp_path / "first")
        assert watched.of(READ)[LEVEL] == recorded(tmp_path / "first")[LEVEL]
        assert _shown(watched)["tiles"]["controller"]["value"] == "mpc"


def test_samples_where_there_is_no_bag(
    domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are said to be such, and each is that of its tick."""
    monkeypatch.setattr(feed, "FASTEST", 3.0)  # a busy machine is slower than 66 at moments
    bring_up(domain, tmp_path, "--hours", "0.3", output="recorded")
    with fed(domain) as (watched, _):
        run = Process(
            domain, "bringup", "--hours", "0.3", "--speed", "100", "--no-record",
            "--output", "run", cwd=tmp_path,
        )
        assert run.wait(300) == 0, run.stderr()
        wait_for(lambda: watched.mode == "ended", 60, "the end of the run")
        heard = watched.of(HEARD)
        notes = [note for _, source, note in watched.present if source == "samples"]
    assert notes and all(note.startswith("Shows samples: ") for note in notes)
    bag = recorded(tmp_path / "recorded")
    assert set(heard) == {LEVEL, "/cistern/level", "/pump/command"}
    for topic in (LEVEL, "/cistern/level"):
        assert heard[topic].items() <= bag[topic].items()
    assert len(heard[LEVEL]) > 3


def test_hostile_diagnostics(domain: int) -> None:
    """Whatever is said there, the feed goes on; a run that is not one changes nothing."""
    values: list[dict[str, str]] = [
        {"role": '"plant"', "process": '"a 1"', "tick": "1" * 4000},
        {"role": '"plant"', "process": '"b 1"', "tick": "1e999", "run_length": "-5"},
        {"role": '"plant"', "process": '"c 1"', "tick": "true", "roof_level": "NaN"},
        {"role": '"plant"', "process": '"c 1"', "tick": "5", "roof_level": "1" * 400},
        {"role": '"recorder"', "process": '"d 1"', "bag": '"/etc/passwd\\u0000"'},
        {"role": '"recorder"', "process": '"x"', "bag": '"/proc"'},
        {"role": "[" * 100_000, "process": "{"},
        {"role": '"pump"', "process": '"e 1"', "flow": '"<script>"'},
    ]
    with fed(domain) as (watched, _), in_domain(domain):
        peer = Peer(domain, "stranger")
        publisher = peer.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        wait_for(lambda: publisher.get_subscription_count() == 1, 60, "the subscription")
        for state in ("ready", "finished", "none"):
            for each in values:
                pairs = [KeyValue(key=key, value=value) for key, value in each.items()]
                status = DiagnosticStatus(name="/x", message=state, values=pairs)
                publisher.publish(DiagnosticArray(status=[status] * 20))
        publisher.publish(
            DiagnosticArray(status=[DiagnosticStatus(name="/y" * 1000, message="m" * 10**5)] * 500)
        )
        time.sleep(1.0)
        status = DiagnosticStatus(
            level=DiagnosticStatus.ERROR, name="/fan", message="stands", hardware_id="fan"
        )

        def shown() -> bool:
            publisher.publish(DiagnosticArray(status=[status]))
            document = read_document(watched, time.monotonic())
            assert len(json.dumps(document)) < 100_000
            assert "could not be shown" not in json.dumps(document["notes"])
            return any("stands" in alarm["what"] for alarm in document["alarms"])

        wait_for(shown, 60, "an alarm")
        peer.close()


def test_stop_is_for_the_one_pump_node_that_is_shown(domain: int) -> None:
    """A name that is none, and two nodes that claim the pump, are refused in words, and soon."""

    def pump(name: str, process: str) -> DiagnosticStatus:
        said = {"role": "pump", "process": process, "pump": "running: as commanded"}
        pairs = [KeyValue(key=key, value=json.dumps(value)) for key, value in said.items()]
        return DiagnosticStatus(name=name, message="ready", values=pairs)

    def refusal(feed: Feed) -> str:
        began = time.monotonic()
        with pytest.raises(StopFailedError) as refused:
            feed.ask("stop")
        assert time.monotonic() - began < 15
        return str(refused.value)

    with fed(domain) as (watched, feed), in_domain(domain):
        peer = Peer(domain, "stranger")
        publisher = peer.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        wait_for(lambda: publisher.get_subscription_count() == 1, 60, "the subscription")

        def stop_of(*pumps: DiagnosticStatus) -> dict[str, Any]:
            publisher.publish(DiagnosticArray(status=pumps))
            document = read_document(watched, time.monotonic())
            assert "met an error" not in json.dumps(document["notes"])
            return document["stop"]

        for _ in range(5):
            assert not stop_of(pump("/no such name!", "x 1"))["possible"]
            time.sleep(0.1)
        assert "no pump node" in refusal(feed)
        wait_for(lambda: stop_of(pump("/pump", "a 1"))["node"] == "/pump", 60, "the pump node")
        assert refusal(feed) == "/pump has no page_stop service that answers."
        both = pump("/pump", "a 1"), pump("/other", "b 1")
        wait_for(lambda: stop_of(*both)["warning"], 60, "a warning")
        stop = stop_of(*both)
        assert not stop["possible"]
        assert "/pump (a 1) and /other (b 1)" in refusal(feed)
        peer.close()


def test_a_bag_that_is_followed_before_its_run_is_described(domain: int, tmp_path: Path) -> None:
    """Who commanded is read at the end; what happened before any value is of the run's time."""
    own = f"{socket.gethostname()} 1"

    def node(role: str, state: str, **values: Any) -> DiagnosticStatus:
        pairs = {"role": role, "process": own, "run_length": 100, **values}
        texts = [KeyValue(key=key, value=json.dumps(value)) for key, value in pairs.items()]
        return DiagnosticStatus(name=f"/{role}", message=state, values=texts)

    with fed(domain, tmp_path / "bag") as (watched, _), in_domain(domain):
        peer = Peer(domain, "stranger")
        publisher = peer.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        wait_for(lambda: publisher.get_subscription_count() == 1, 60, "the subscription")

        def is_so(state: str, mode: str) -> bool:
            said = DiagnosticArray(status=[node("plant", state, tick=5), node("recorder", state)])
            said.header.stamp.sec = 1_626_757_200
            publisher.publish(said)
            publisher.publish(DiagnosticArray(status=[DiagnosticStatus(name="/fan")]))
            return watched.mode == mode

        wait_for(lambda: is_so("ready", "simulated"), 60, "the run")
        (tmp_path / "summary.json").write_text('{"controller": "mpc"}')
        wait_for(lambda: is_so("finished", "ended"), 60, "its end")
        wait_for(
            lambda: _shown(watched)["tiles"]["controller"]["value"] == "mpc", 60, "its controller"
        )
        events = _shown(watched)["events"]
        assert "The run ended." in [event["what"] for event in events]
        assert {event["at"] for event in events} == {1_626_757_200}
        peer.close()


def test_a_live_site_after_a_run_has_nothing_of_it(domain: int) -> None:
    """A watcher that stays shows no level of a simulation as that of the site."""

    def node(role: str, state: str, **values: Any) -> DiagnosticStatus:
        pairs = {"role": role, "process": "host 1", **values}
        texts = [KeyValue(key=key, value=json.dumps(value)) for key, value in pairs.items()]
        return DiagnosticStatus(name=f"/{role}", message=state, values=texts)

    with fed(domain) as (watched, _), in_domain(domain):
        peer = Peer(domain, "stranger")
        publisher = peer.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        wait_for(lambda: publisher.get_subscription_count() == 1, 60, "the subscription")

        def is_so(mode: str, *nodes: DiagnosticStatus) -> bool:
            said = DiagnosticArray(status=list(nodes))
            said.header.stamp.sec = 1_626_757_200
            publisher.publish(said)
            return watched.mode == mode

        run = {"run_length": 100, "tick": 5}
        wait_for(lambda: is_so("simulated", node("plant", "ready", **run)), 60, "the run")
        wait_for(lambda: is_so("ended", node("plant", "ended", **run)), 60, "its end")
        assert watched.runs == 0
        wait_for(lambda: is_so("live", node("controller", "ready")), 60, "the live site")
        assert watched.runs == 1
        peer.close()


class Broken(Kept):
    """Cannot be told what is watched."""

    def set_present(self, **_: Any) -> None:
        raise ValueError("broken")


def test_a_stop_is_answered_whatever_else_fails(domain: int) -> None:
    with in_domain(domain), Feed(Broken()) as feed:
        time.sleep(0.5)
        began = time.monotonic()
        with pytest.raises(StopFailedError, match="no pump node"):
            feed.ask("stop")
        assert time.monotonic() - began < 15


def test_without_a_graph(domain: int, tmp_path: Path) -> None:
    """Nothing is heard yet; a bag that is none is said; it ends at once."""
    with fed(domain, tmp_path / "none") as (watched, _):
        wait_for(lambda: watched.present, 60, "a word")
        wait_for(
            lambda: any("There is no recording at" in note for *_, note in watched.present), 60,
            "the note",
        )
    with fed(domain) as (watched, _):
        wait_for(lambda: watched.present, 60, "a word")
        assert watched.present == [("none", "heard", "")]
        began = time.monotonic()
    assert time.monotonic() - began < 15
    assert not [thread for thread in threading.enumerate() if thread.name == HEARD]


def test_a_watcher_that_was_stopped(domain: int, tmp_path: Path) -> None:
    """What it missed then comes from the bag, and nothing is at another tick."""
    program = (
        "import pickle, sys\n"
        "from test_feed import fed, ended, Path, wait_for\n"
        "with fed(int(sys.argv[1])) as (watched, _):\n"
        "    for least in (100, 200, 300):\n"
        "        heard = lambda: len(watched.of('graph').get('/roof/level', ()))\n"
        "        wait_for(lambda: heard() > least, 400, 'levels')\n"
        "        print('hears', flush=True)\n"
        "    sys.stdin.readline()\n"
        "    ended(watched, Path(sys.argv[2]))\n"
        "with open(sys.argv[3], 'wb') as stream:\n"
        "    pickle.dump((dict(watched.values), watched.runs), stream)\n"
    )
    run = Process(
        domain, "bringup", "--speed", "30", "--hours", "4", "--output", "run", cwd=tmp_path
    )
    path = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
    process = subprocess.Popen(
        [sys.executable, "-c", program, str(domain), str(tmp_path / "run"), str(tmp_path / "kept")],
        env={**environment(domain), "PYTHONPATH": path}, text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "hears\n"
    for _ in range(2):
        process.send_signal(signal.SIGSTOP)
        time.sleep(4)
        process.send_signal(signal.SIGCONT)
        assert process.stdout.readline() == "hears\n"
    run.process.send_signal(signal.SIGINT)
    assert run.wait(300) == EXIT_INTERRUPTED, run.stderr()
    process.communicate("the run has ended\n", timeout=200)
    assert process.returncode == 0
    kept = Kept()
    values, kept.runs = pickle.loads((tmp_path / "kept").read_bytes())
    kept.values.update(values)
    assert kept.runs == 0
    check_heard(kept, tmp_path / "run", 100)
