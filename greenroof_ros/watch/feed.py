"""Feeds the store: from the graph that runs and from the bag that it writes.

A watcher must not slow down the graph: see :mod:`greenroof_ros.watch.graph_client`. But each of its
subscriptions costs the publisher time in every tick, so it receives the numbers of a run only up to
a certain speed. Above that it receives only /diagnostics.

Live messages are the present. The past comes from a bag that grows, if there is one: in order and
with nothing missing. If there is none, live messages become the past.
"""

from __future__ import annotations

import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import default_site_file
from greenroof_ros.common.interface import read_topics
from greenroof_ros.experiment.summary import site_file_of
from greenroof_ros.graph.states import RECORDER
from greenroof_ros.model.site import read_site
from greenroof_ros.watch import wire
from greenroof_ros.watch.alarms import read_run_files
from greenroof_ros.watch.bag import BagProcess, Batch
from greenroof_ros.watch.graph_client import DIAGNOSTICS, GraphClient, PumpRequestError
from greenroof_ros.watch.store import PLAN, GraphStore

# The fastest run, in times real time, whose numbers are received: 60 and some jitter.
FASTEST = 66.0
# How often the watcher receives new messages, and how often it updates the state of the graph (s).
_POLL_S, _REPORT_S = 0.05, 0.25
# How long received values wait for a bag that does not grow (the recorder of a live site writes
# every 10 s), and for the recorder to report where its bag is (s).
_WAIT_S, _FOUND_S = 30.0, 3.0
# The most messages that wait.
_MOST_WAITING = 200_000
# If this process pauses for longer than this (s), the silence of other nodes means nothing.
_OWN_PAUSE_S = 0.5
# How long an error of the watcher itself is shown, and how long it rests after one (s).
_SHOWN_S, _REST_S = 60.0, 1.0
_STOP_S = 3.0
# A message further than this from the clock (ticks) is of a publisher that was restarted: the plant
# is at most 32 ticks ahead of the recorder, and messages received together are closer.
_FAR = 64

_CLOCK = "/clock"


class Ticks:
    """The simulated time of each message of a run, by the number that its publisher gave it.

    In lockstep the j-th message of a topic belongs to tick j - 1. The order of arrival is less
    reliable: the plant's next clock may arrive before the messages of the tick before it.

    Attributes:
        newest_ns: the newest time of the clock (ns since 1970); 0 before the first.
    """

    def __init__(self) -> None:
        """Start before the first clock."""
        self.newest_ns = 0
        self._clock = 0  # number of the newest clock message
        self._period = 0  # ns

    def clock(self, number: int | None, time_ns: int) -> None:
        """Receive a clock message."""
        number = self._clock + 1 if number is None else number
        if self._clock and number > self._clock:
            self._period = (time_ns - self.newest_ns) // (number - self._clock)
        self._clock, self.newest_ns = number, time_ns

    def time(self, number: int | None) -> int | None:
        """Return the time of a message (ns since 1970); None if it cannot be known.

        Args:
            number: of the message; None if it does not count ticks: it gets the newest time.
        """
        if not self._period:
            return None  # fewer than two clocks were received
        ahead = 0 if number is None else number - self._clock
        return None if abs(ahead) > _FAR else self.newest_ns + ahead * self._period


class Feed:
    """Feeds a :class:`~greenroof_ros.watch.store.GraphStore` while its context is entered."""

    def __init__(
        self, store: GraphStore, *, bag: Path | None = None, site_file: Path | None = None,
        recording: bool = True,
    ) -> None:
        """Start with nothing.

        Args:
            store: the store to feed.
            bag: the bag to read; None for the bag that the graph writes.
            site_file: the site file by which levels are judged; None for the graph's own.
            recording: whether to read the bag that the graph writes; without it, only the present
                is known.

        Raises:
            ConfigurationError: the site file is wrong.
        """
        self._store = store
        self._graph = store.alarms.registry
        self._bag = None if bag is None else bag.resolve()
        self._site_file = site_file
        self._follows = recording
        self._topics = read_topics()
        self._run = 0
        self._lock = threading.Lock()  # of _recorded
        self._recorded: BagProcess | None = None
        self._clear_received()
        self._subscribed_since = 0.0
        self._live: bool | None = None  # whether the graph shown, now or last, is live
        self._site: tuple[Path, int] | None = None  # file, and when it was written (ns)
        self._awake = time.monotonic()
        self._reported_at = 0.0
        self._problem, self._problem_until = "", 0.0
        self._requests: list[tuple[str, dict[str, Any], Future[str]]] = []
        self._request_lock = threading.Lock()  # of that list
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._watch_graph, name="graph", daemon=True)
        self._client: GraphClient | None = None
        self._no_ros = ""
        self._no_incidents = ""
        self._set_site(site_file or self._site_of_graph())

    def _clear_received(self) -> None:
        """Clear received messages that are not part of the past yet."""
        self._ticks = Ticks()
        # Numbers and plans in the order of arrival, each with its time (ns since 1970) and topic.
        self._received: deque[tuple[int, str, float | bytes]] = deque()
        self._waits_since = time.monotonic()

    def __enter__(self) -> Feed:
        """Join the graph.

        Raises:
            ConfigurationError: ROS 2 is not installed, and no bag was given.
        """
        try:
            self._client = GraphClient(self._store.namespace, self._on_message)
        except ConfigurationError as error:
            if self._bag is None:
                raise
            self._no_ros = str(error)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Leave the graph."""
        self._closing.set()
        if self._client is not None:
            self._client.wake()
        self._thread.join(2.0)

    def request_action(self, action: str, **request: Any) -> str:
        """Request a hold, a release, a cleared fault or a dose; callable from any thread.

        Args:
            action: ``stop``, ``release``, ``clear`` or ``dose``.
            request: for a stop or a dose, as the methods hold_pump and request_dose of
                :class:`greenroof_ros.watch.graph_client.GraphClient` take it.

        Returns:
            The pump node's answer.

        Raises:
            PumpRequestError: the pump node did not confirm it.
        """
        future: Future[str] = Future()
        with self._request_lock:
            if action == "stop":
                self._drop_before_stop()
            self._requests.append((action, request, future))
        if self._client is not None:
            self._client.wake()
        try:
            return future.result(2 * _STOP_S + 2.0)
        except FutureTimeoutError:
            what = "the pump node was not asked, and nothing was done"
            if not future.cancel():
                what = "it is unknown whether the pump node did that"
            raise PumpRequestError(f"The watcher is busy: {what}.") from None

    def _drop_before_stop(self) -> None:
        """Cancel requests from before a stop: they must not be carried out after it."""
        for action, _, before in self._requests:
            if action != "stop" and before.set_running_or_notify_cancel():
                before.set_exception(PumpRequestError(
                    "Nothing was done: someone is asking to stop the pump."
                ))
        self._requests = [request for request in self._requests if request[0] == "stop"]

    # --- the graph ------------------------------------------------------------------------------

    def _watch_graph(self) -> None:
        while not self._closing.is_set():
            self._run_cycle()
        self._follow(None)
        if self._client is not None:
            self._client.close()

    def _run_cycle(self) -> None:
        """Receive new messages and show them; if a step fails, the others are done all the same."""
        failed = [act for act in (
            self._receive, self._update_graph, self._answer, self._move_to_past, self._report,
        ) if self._fails(act)]
        # An error may come again at once; but a request such as a stop must not wait for that.
        until = time.monotonic() + (_REST_S if failed else 0.0)
        while time.monotonic() < until and not self._requests and not self._closing.is_set():
            self._closing.wait(_POLL_S)

    def _fails(self, act: Callable[[], None]) -> bool:
        """Do a step; if it fails, show the error and return True."""
        try:
            act()
        except Exception as error:  # for any error, the others go on
            self._problem = (
                f"Something could not be shown; the rest goes on ({type(error).__name__}: {error})."
            )
            self._problem_until = time.monotonic() + _SHOWN_S
            return True
        return False

    def _receive(self) -> None:
        if self._client is None:
            self._closing.wait(_REPORT_S)
        else:
            self._client.receive(_POLL_S)
        self._excuse_own_pause()

    def _update_graph(self) -> None:
        """Update which graph is there, and subscribe to it and follow its bag as needed."""
        now = time.monotonic()
        mode = self._graph.mode(now)
        if self._bag is not None and (mode == "none" or not self._shows_graph()):
            mode = "ended"
        live = {"simulated": False, "loop": False, "live": True}.get(mode, self._live)
        replaced = self._recorded is not None and self._recorded.read.replaced
        if self._graph.runs != self._run or replaced or self._live not in (None, live):
            self._run, self._site = self._graph.runs, None
            self._forget()
            self._store.add_event(time.time(), "Another run began.")
        self._live = live
        if mode != self._store.mode:
            if mode == "ended" and self._store.mode != "none":
                self._store.add_event(time.time(), "The run ended.")
            if self._store.mode == "none":
                self._waits_since = now
            with self._store.lock:
                self._store.mode = mode
            if mode == "ended" and self._recorded is not None:
                # The bag may have been followed before the controller's name was written.
                self._read_run_files(self._recorded.bag)
            self._report_now()  # before new values: an account has other rules on a live site
        self._set_site(self._site_file or self._site_of_graph())
        bag = self._bag or (self._graph.bag() if self._follows else None)
        if bag is not None and (self._recorded is None or self._recorded.bag != bag):
            self._follow(bag)
        if self._client is not None:
            self._choose_topics(now)

    def _shows_graph(self) -> bool:
        """Return whether the present graph is shown: not if another graph's bag was asked for."""
        if self._bag is None:
            return True
        return self._graph.node(RECORDER) is not None and self._graph.bag() in (None, self._bag)

    def _forget(self) -> None:
        """Forget everything that is shown; a recording is read again."""
        self._clear_received()
        self._follow(None)
        self._store.reset()

    def _follow(self, bag: Path | None) -> None:
        """Follow another bag, or none."""
        # Batches of the previous bag that are still on their way are not shown any more.
        with self._lock:
            before, self._recorded = self._recorded, None
        if before is not None:
            before.close()
        if bag is not None:
            self._read_run_files(bag)
            namespace = self._store.namespace if self._bag is None else None
            with self._lock:
                self._recorded = BagProcess(bag, namespace, self._on_batch)

    def _read_run_files(self, bag: Path) -> None:
        """Read the controller's name and the incidents of a recorded run."""
        store = self._store
        controller, incidents, self._no_incidents = read_run_files(bag)
        store.recorded_controller, store.recorded_incidents = controller, incidents

    def _on_batch(self, recorded: BagProcess, batch: Batch) -> None:
        """Receive a batch; numbers last, since they move *now* on, and plans must be there then."""
        with self._lock:
            if recorded is not self._recorded:
                return
            for (topic, _), (time_ns, message) in batch.messages.items():
                self._store.receive(topic, time_ns, message, past=True)
            for topic, times, values in batch.numbers:
                self._store.add(topic, times, values)

    def _site_of_graph(self) -> Path | None:
        if self._shows_graph() and (site := self._graph.site()) is not None:
            return site
        if self._bag is not None:
            site = site_file_of(self._bag.parent)
            return site if site.is_file() else None
        return None

    def _set_site(self, path: Path | None) -> None:
        """Set the site by which levels are judged from a file, or to the paper's."""
        file = path or default_site_file()
        try:
            as_is = file, file.stat().st_mtime_ns
        except OSError:
            as_is = file, 0
        if as_is == self._site:
            return
        self._site = as_is
        note = "" if path else "Levels are judged by the paper's site, config/site.yaml."
        try:
            site = read_site(file)
        except ConfigurationError as error:
            if path is None or path == self._site_file:
                raise
            note = f"The site file cannot be read, so levels are judged by the paper's: {error}"
            site = read_site(default_site_file())
        another = site != self._store.site
        self._store.set_site(site, note)
        if another and self._recorded is not None:
            self._forget()  # the account was for another site

    def _choose_topics(self, now: float) -> None:
        """Subscribe to as much as the graph can bear."""
        assert self._client is not None
        listens, live = self._subscribed_since > 0, self._store.mode == "live"
        wanted = live
        if self._running:
            factor = self._factor
            # The speed of a run that has not begun, or that stands still, is unknown.
            wanted = listens if not factor else factor <= FASTEST
        if wanted == listens:
            return
        self._client.subscribe([
            name for name, topic in self._topics.items()
            if (topic.live and name != DIAGNOSTICS) or (topic.per_tick and not live)
        ] if wanted else ())
        self._subscribed_since = now if wanted else 0.0
        if not wanted:
            self._move_to_past()
            self._clear_received()

    @property
    def _factor(self) -> float | None:
        """Simulated time per wall time; None if unknown."""
        return self._graph.factor(self._store.site.tau)

    @property
    def _running(self) -> bool:
        """Whether a simulation runs."""
        return self._store.mode in ("simulated", "loop")

    # --- incoming messages ----------------------------------------------------------------------

    def _on_message(self, name: str, message: bytes, number: int | None, arrived_ns: int) -> None:
        """Receive a message; if that fails, the others are received all the same."""
        self._fails(lambda: self._receive_message(name, message, number, arrived_ns))

    def _excuse_own_pause(self) -> None:
        """Excuse the silence of the nodes while this process stood still."""
        before, self._awake = self._awake, time.monotonic()
        if self._awake - before > _OWN_PAUSE_S:
            with self._store.lock:
                self._graph.excuse_silence(self._awake - before)

    def _receive_message(
        self, name: str, message: bytes, number: int | None, arrived_ns: int
    ) -> None:
        self._excuse_own_pause()
        if name == DIAGNOSTICS:
            if (received := wire.statuses(message)) is not None:
                stamp_ns, statuses = received
                now = time.monotonic()
                self._store.add_statuses(now, statuses, stamp_ns, arrived_ns / 1e9)
            return
        if name == _CLOCK:
            if (time_ns := wire.clock(message)) is not None:
                self._ticks.clock(number, time_ns)
            return
        topic = self._topics[name]
        stamp: int | None = arrived_ns
        if self._store.mode != "live":
            stamp = self._ticks.newest_ns
            if topic.per_tick:
                # A pump driver from another package may have begun at any tick.
                own = any(self._graph.node(role) for role in topic.publishers)
                stamp = self._ticks.time(number if own else None)
        if not stamp:
            return
        if not self._store.is_number(name):
            self._store.receive(name, stamp, message, past=False)
            if name == PLAN:
                self._received.append((stamp, name, message))
        elif (value := wire.number(message)) is not None:
            self._store.add_present(name, stamp, value)
            self._received.append((stamp, name, value))

    def _move_to_past(self) -> None:
        """Move received messages to the past, if no bag brings the past."""
        now = time.monotonic()
        if self._shows_samples(now) and self._graph.samples is not None:
            time_ns, values = self._graph.samples
            for topic, value in values.items():
                self._store.add(topic, np.array([time_ns]), np.array([value]))
        recorded = self._recorded
        if len(self._received) > _MOST_WAITING or not self._past_is_read(now):
            numbers: defaultdict[str, list[tuple[int, float]]] = defaultdict(list)
            for time_ns, topic, received in self._received:
                if isinstance(received, bytes):
                    self._store.receive(topic, time_ns, received, past=True)
                else:
                    numbers[topic].append((time_ns, received))
            self._received.clear()
            for topic, pairs in numbers.items():
                times, series = zip(*pairs, strict=True)
                self._store.add(topic, np.array(times, np.int64), np.array(series))
        elif recorded is not None:
            while self._received and self._received[0][0] <= recorded.read.newest_ns:
                self._received.popleft()

    def _past_is_read(self, now: float) -> bool:
        """Return whether a bag brings the past, or may soon."""
        recorded = self._recorded
        if recorded is None:
            return now - max(self._subscribed_since, self._waits_since) < _FOUND_S
        read = recorded.read
        return not read.problem and (read.more or now - recorded.grew_at < _WAIT_S)

    def _shows_samples(self, now: float) -> bool:
        """Return whether the run is too fast to be received in full, and no recording is here.

        If none is to be read, also while the run's speed is still unknown.
        """
        if not self._follows:
            return self._running and not self._subscribed_since
        recorded = self._recorded is not None and not self._recorded.read.problem
        too_fast = not self._subscribed_since and (self._factor or 0.0) > FASTEST
        waited = now - self._waits_since > _FOUND_S
        return self._running and too_fast and waited and not recorded

    # --- state of the graph ---------------------------------------------------------------------

    def _report(self) -> None:
        if time.monotonic() - self._reported_at >= _REPORT_S:
            self._report_now()

    def _report_now(self) -> None:
        now, mode, recorded = time.monotonic(), self._store.mode, self._recorded
        self._reported_at = now
        notes = [self._problem] if now < self._problem_until else []
        if self._no_ros:
            notes.append(f"Only the recording is shown: {self._no_ros}.")
        if recorded is not None:
            if mode in ("live", "ended"):
                notes.append(self._no_incidents)
            notes += [recorded.read.problem, recorded.read.progress]
        shown = self._shows_graph()
        if not shown and self._graph.mode(now) not in ("none", "ended"):
            notes.append(f"Another graph runs here; {self._bag} is shown.")
        if self._follows and self._shows_samples(now):
            notes.append(
                "Shows samples: the run is too fast to be received in full, and there is no "
                "recording of it here."
            )
        self._store.set_present(
            mode=mode, factor=self._factor if self._running else None,
            note=" ".join(filter(None, notes)), graph_shown=shown,
        )
        self._store.update(now, time.time())

    # --- stopping -------------------------------------------------------------------------------

    def _connect_pump(self) -> None:
        """Look for the services of the pump node, so that a call finds them at once.

        Raises:
            PumpRequestError: two nodes claim to be the pump node.
        """
        assert self._client is not None
        now, graph = time.monotonic(), self._store.graph
        node, two = graph.pump(now), graph.two_pumps(now)
        self._client.connect_pump(None if two or node is None else node.name)
        if two:
            raise PumpRequestError(two)

    def _answer(self) -> None:
        if (client := self._client) is None:
            return
        acts: dict[str, Callable[..., str]] = {
            "stop": client.hold_pump, "release": client.release_pump, "clear": client.clear_fault,
            "dose": client.request_dose,
        }
        while self._requests:
            with self._request_lock:
                action, request, future = self._requests.pop(0)
            if future.set_running_or_notify_cancel():
                try:
                    self._connect_pump()
                    future.set_result(acts[action](**request, timeout_s=_STOP_S))
                except Exception as error:  # it is raised in the thread that asked
                    future.set_exception(error)
        with suppress(PumpRequestError):
            self._connect_pump()
