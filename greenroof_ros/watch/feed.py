"""Feeds what is shown: from the graph that is there and from the bag that it writes.

A watcher must hold nobody up: see :mod:`greenroof_ros.graph.looker`. What it subscribes to costs
its publishers time in each tick all the same, so that it hears the numbers of a run only up to some
speed. Above it /diagnostics is all that it hears.

What is heard is of now. The past comes from the bag, where there is one that grows: in order, and
with nothing missing. What is heard becomes the past where there is none.
"""

from __future__ import annotations

import queue
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
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import shared_directory
from greenroof_ros.common.interface import read_topics
from greenroof_ros.experiment.incidents import INCIDENTS
from greenroof_ros.experiment.summary import SUMMARY, site_file_of
from greenroof_ros.graph.looker import DIAGNOSTICS, Looker, StopFailedError
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.watch import wire
from greenroof_ros.watch.bag import Batch, FollowedBag, controller_of, read_incidents_of
from greenroof_ros.watch.store import Store

# Up to how many times real time the numbers of a run are heard: 60 and its jitter.
FASTEST = 66.0
# How often the watcher looks at what came (s), and how often it says how the graph is.
_LOOK_S, _SAY_S = 0.05, 0.25
# For how long what is heard waits for a bag that does not grow (s), and for the recorder to say
# where its bag is; the recorder of a live site writes every 10 s.
_WAIT_S, _FOUND_S = 30.0, 3.0
# Of one topic, how many messages wait at most.
_MOST_WAITING = 20_000
# A pause of this process after which those that were not heard meanwhile may have spoken (s).
_OWN_PAUSE_S = 0.5
# For how long an error of the watcher's own is shown (s), and how long it rests after it.
_SHOWN_S, _REST_S = 60.0, 1.0
_STOP_S = 3.0
# Of one message of /diagnostics, how many statuses go on.
_STATUSES = 200
# A tick of which a message is further away is of a publisher that was started again: the plant runs
# 32 ticks ahead of the recorder at most, and what is heard at one time is of fewer.
_FAR = 64

_CLOCK, _PLAN = "/clock", "/controller/plan"


class Ticks:
    """The simulated time of each message of a run, by the number that its publisher gave it.

    In lockstep the j-th message of a topic belongs to tick j - 1. When messages come says less: the
    plant's next clock may come before what moved in the tick before.

    Attributes:
        newest_ns: the newest time of the clock (ns since 1970); 0 before it was heard.
    """

    def __init__(self) -> None:
        """Begin before the first clock."""
        self.newest_ns = 0
        self._clock = 0  # the number of that message
        self._period = 0  # ns
        self._strangers: dict[str, int] = {}

    def clock(self, number: int | None, time_ns: int) -> None:
        """Hear the clock."""
        number = self._clock + 1 if number is None else number
        if self._clock and number > self._clock:
            self._period = (time_ns - self.newest_ns) // (number - self._clock)
        self._clock, self.newest_ns = number, time_ns

    def time(self, topic: str, number: int | None, *, from_tick_0: bool) -> int | None:
        """Return the time of a message (ns since 1970); None where it cannot be known.

        Args:
            topic: its name.
            number: of the message.
            from_tick_0: whether its publisher's first message is that of tick 0, which a pump
                driver of somebody else's does not say.
        """
        if not self._period:
            return None  # less than two clocks were heard
        if number is None:
            return self.newest_ns
        ahead = number - self._clock
        if not from_tick_0:
            # One that was there from the beginning has numbered as the plant has.
            first = 0 if abs(ahead) <= 1 else -ahead
            ahead += self._strangers.setdefault(topic, first)
        return None if abs(ahead) > _FAR else self.newest_ns + ahead * self._period


class Feed:
    """Feeds a :class:`~greenroof_ros.watch.store.Store` for as long as it is entered."""

    def __init__(
        self, store: Store, *, bag: Path | None = None, site_file: Path | None = None
    ) -> None:
        """Begin with nothing.

        Args:
            store: what is fed.
            bag: to read; None for the one that the graph writes.
            site_file: by which levels are judged; None for the graph's own.

        Raises:
            ConfigurationError: the site file is wrong.
        """
        self._store = store
        self._graph = store.alarms.registry
        self._bag = None if bag is None else bag.resolve()
        self._site_file = site_file
        self._topics = read_topics()
        self._run = 0
        self._lock = threading.Lock()  # of the bag that is read
        self._recorded: FollowedBag | None = None
        self._begin_hearing()
        self._listens_since = 0.0
        self._mode = "none"
        self._live: bool | None = None  # the graph that is shown, or was shown last
        self._site: Path | None = None
        self._judged_by: Site | None = None
        self._tau = 1.0
        self._awake = time.monotonic()
        self._said = 0.0
        self._problem, self._problem_until = "", 0.0
        self._asked: queue.SimpleQueue[tuple[str, Future[str]]] = queue.SimpleQueue()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._watch_graph, name="graph", daemon=True)
        self._looker: Looker | None = None
        self._no_ros = ""
        self._incidents_read: list[tuple[int, int] | None] = []
        self._no_incidents = ""
        self._judge_by(site_file or self._site_of_graph())

    def _begin_hearing(self) -> None:
        """Forget what was heard and is not yet of the past."""
        self._ticks = Ticks()
        self._numbers: defaultdict[str, deque[tuple[int, float]]] = defaultdict(deque)
        self._plans: deque[tuple[int, NDArray[np.float64]]] = deque()
        self._waits_since = time.monotonic()

    def __enter__(self) -> Feed:
        """Join the graph.

        Raises:
            ConfigurationError: ROS 2 is not installed, and no bag was given.
        """
        try:
            self._looker = Looker(self._store.namespace, self._on_message)
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
        if self._looker is not None:
            self._looker.wake()
        self._thread.join(2.0)

    def ask(self, action: str) -> str:
        """Have the pump held off or released, or its fault cleared, from any thread.

        Args:
            action: ``stop``, ``release`` or ``clear``.

        Returns:
            What the pump node says.

        Raises:
            StopFailedError: it did not say that it did so.
        """
        asked: Future[str] = Future()
        self._asked.put((action, asked))
        if self._looker is not None:
            self._looker.wake()
        try:
            return asked.result(_STOP_S + 2.0)
        except FutureTimeoutError:
            asked.cancel()
            raise StopFailedError(
                "The watcher is busy: whether the pump node did that is not known."
            ) from None

    # --- the graph ------------------------------------------------------------------------------

    def _watch_graph(self) -> None:
        while not self._closing.is_set():
            self._look()
        self._follow(None)
        if self._looker is not None:
            self._looker.close()

    def _look(self) -> None:
        """Take all that came, and show it; what fails of it keeps nothing else from being done."""
        failed = self._fails(self._hear)
        self._forgive_own_pause()
        now = time.monotonic()
        failed |= self._fails(lambda: self._see_graph(now))
        if self._looker is not None:
            failed |= self._fails(self._prepare_stop)
            self._answer_stops()
        failed |= self._fails(lambda: self._hand_on(now))
        if now - self._said > _SAY_S:
            failed |= self._fails(lambda: self._say(now))
        # An error may come again at once; a stop waits for none.
        until = time.monotonic() + (_REST_S if failed else 0.0)
        while time.monotonic() < until and self._asked.empty() and not self._closing.is_set():
            self._closing.wait(_LOOK_S)

    def _fails(self, act: Callable[[], None]) -> bool:
        """Do something; what is wrong with it is shown."""
        try:
            act()
        except Exception as error:  # whatever it is, the others go on
            self._problem = (
                f"Something could not be shown; all else goes on ({type(error).__name__}: {error})."
            )
            self._problem_until = time.monotonic() + _SHOWN_S
            return True
        return False

    def _hear(self) -> None:
        if self._looker is None:
            self._closing.wait(_SAY_S)
        else:
            self._looker.look(_LOOK_S)

    def _see_graph(self, now: float) -> None:
        """Take in which graph is there, and hear and read what is to be shown of it."""
        mode = self._shown_mode(now)
        live = {"simulated": False, "loop": False, "live": True}.get(mode, self._live)
        recorded = self._recorded
        if (
            self._graph.runs != self._run or (recorded is not None and recorded.replaced)
            or self._live not in (None, live)
        ):
            self._run, self._site = self._graph.runs, None
            self._forget()
            self._store.add_event(time.time(), "Another run began.")
        self._live = live
        if mode != self._mode:
            if mode == "ended" and self._mode != "none":
                self._store.add_event(time.time(), "The run ended.")
            if self._mode == "none":
                self._waits_since = now
            self._mode = mode
            if mode == "ended" and self._recorded is not None:
                # A bag may be followed before anything says who commands.
                self._store.set_recording(controller_of(self._recorded.bag))
            self._say(now)  # before what comes: an account has other rules on a live site
        self._judge_by(self._site_file or self._site_of_graph())
        bag = self._bag or self._graph.bag()
        if bag is not None and (self._recorded is None or self._recorded.bag != bag):
            self._follow(bag)
        if self._looker is not None:
            self._choose_topics(now)

    def _shows_graph(self) -> bool:
        """Whether the graph that is there is shown: not where another one's bag was asked for."""
        if self._bag is None:
            return True
        return self._graph.records and self._graph.bag() in (None, self._bag)

    def _shown_mode(self, now: float) -> str:
        mode = self._graph.mode(now)
        if self._bag is not None and (mode == "none" or not self._shows_graph()):
            return "ended"
        return mode

    def _forget(self) -> None:
        """Forget all that is shown; it is read again where it is recorded."""
        self._begin_hearing()
        self._follow(None)
        self._store.begin_anew()

    def _follow(self, bag: Path | None) -> None:
        """Follow another bag, or none."""
        # What the one before has still on its way is not shown any more.
        with self._lock:
            before, self._recorded = self._recorded, None
        if before is not None:
            before.close()
        self._incidents_read = []
        if bag is not None:
            self._store.set_recording(controller_of(bag))
            namespace = self._store.namespace if self._bag is None else None
            with self._lock:
                self._recorded = FollowedBag(bag, namespace, self._on_batch)

    def _on_batch(self, recorded: FollowedBag, batch: Batch) -> None:
        """Take a batch; numbers last: they move now on, and its plans are there by then."""
        with self._lock:
            if recorded is not self._recorded:
                return
            for topic, (time_ns, message) in batch.forecasts.items():
                self._add_forecast(topic, time_ns, message)
            for time_ns, plan in batch.plans:
                self._store.add_plan(time_ns, plan)
            for topic, time_ns, text in batch.texts:
                self._store.add_text(topic, time_ns, text)
            for topic, (times, values) in batch.numbers.items():
                self._store.add(topic, times, values)

    def _site_of_graph(self) -> Path | None:
        if self._shows_graph() and (site := self._graph.site()) is not None:
            return site
        if self._bag is not None:
            site = site_file_of(self._bag.parent)
            return site if site.is_file() else None
        return None

    def _judge_by(self, path: Path | None) -> None:
        """Judge levels by a site file, or by the paper's where there is none."""
        papers = shared_directory() / "config" / "site.yaml"
        file = path or papers
        if file == self._site:
            return
        self._site = file
        note = "" if path else "Levels are judged by the paper's site, config/site.yaml."
        try:
            site = read_site(file)
        except ConfigurationError as error:
            if path is None or path == self._site_file:
                raise
            note = f"The site file cannot be read, and levels are judged by the paper's: {error}"
            site = read_site(papers)
        another, self._judged_by, self._tau = site != self._judged_by, site, site.tau
        self._store.set_site(site, note)
        if another and self._recorded is not None:
            self._forget()  # what was counted of it was judged by another site

    def _choose_topics(self, now: float) -> None:
        """Subscribe to what the graph can bear."""
        assert self._looker is not None
        listens, live = self._listens_since > 0, self._mode == "live"
        wanted = live
        if self._running:
            factor = self._graph.factor(self._tau)
            # A run that has not begun, or that stands, says nothing of its speed.
            wanted = listens if not factor else factor <= FASTEST
        if wanted == listens:
            return
        self._looker.listen([
            name for name, topic in self._topics.items()
            if (topic.live and name != DIAGNOSTICS) or (topic.per_tick and not live)
        ] if wanted else ())
        self._listens_since = now if wanted else 0.0
        if not wanted:
            self._hand_on(now)
            self._begin_hearing()

    @property
    def _running(self) -> bool:
        """Whether a simulation runs."""
        return self._mode in ("simulated", "loop")

    # --- what comes -----------------------------------------------------------------------------

    def _on_message(self, name: str, message: bytes, number: int | None, arrived_ns: int) -> None:
        """Take a message that came; one that cannot be taken keeps none of the others away."""
        self._fails(lambda: self._take(name, message, number, arrived_ns))

    def _forgive_own_pause(self) -> None:
        """Have no node taken for silent because this process stood still."""
        before, self._awake = self._awake, time.monotonic()
        if self._awake - before > _OWN_PAUSE_S:
            self._store.forgive(self._awake - before)

    def _take(self, name: str, message: bytes, number: int | None, arrived_ns: int) -> None:
        self._forgive_own_pause()
        if name == DIAGNOSTICS:
            self._on_diagnostics(message, arrived_ns)
            return
        if name == _CLOCK:
            time_ns = wire.clock(message)
            if time_ns is not None:
                self._ticks.clock(number, time_ns)
            return
        topic = self._topics[name]
        stamp: int | None = arrived_ns
        if self._mode != "live":
            stamp = self._ticks.newest_ns
            if topic.per_tick:
                from_tick_0 = self._graph.begins_with_run(topic)
                stamp = self._ticks.time(name, number, from_tick_0=from_tick_0)
        if not stamp:
            return
        if name == _PLAN:
            plan = wire.rows(message)
            if plan is not None and len(plan[0]):
                self._plans.append((stamp, plan[0]))
                self._store.add_plan(stamp, plan[0], past=False)
        elif topic.type.endswith("MultiArray"):
            self._add_forecast(name, stamp, message)
        elif topic.type.endswith("String"):
            text = wire.text(message)
            if text is not None:
                self._store.add_text(name, stamp, text)
        else:
            value = wire.number(message)
            if value is not None:
                self._numbers[name].append((stamp, value))

    def _add_forecast(self, topic: str, time_ns: int, message: bytes) -> None:
        found = wire.rows(message)
        if found is not None:
            self._store.add_forecast(topic, time_ns, *found)

    def _on_diagnostics(self, message: bytes, arrived_ns: int) -> None:
        found = wire.statuses(message)
        if found is None:
            return
        stamp, statuses = found
        statuses.sort(key=lambda status: not self._graph.is_own(status))
        self._store.add_statuses(
            time.monotonic(), statuses[:_STATUSES], stamp, arrived_ns / 1e9
        )

    def _hand_on(self, now: float) -> None:
        """Show what was heard; it becomes the past where no bag brings that."""
        for topic, waiting in self._numbers.items():
            if waiting:
                self._store.add_now(topic, *waiting[-1])
        if self._source(now) == "samples" and self._graph.samples is not None:
            time_ns, values = self._graph.samples
            for topic, value in values.items():
                self._store.add(topic, np.array([time_ns]), np.array([value]))
        recorded = self._recorded
        queues: list[deque[Any]] = [*self._numbers.values(), self._plans]
        if any(len(one) > _MOST_WAITING for one in queues) or not self._past_is_read(now):
            for time_ns, plan in self._plans:
                self._store.add_plan(time_ns, plan)
            self._plans.clear()
            for topic, waiting in self._numbers.items():
                if waiting:
                    times, numbers = zip(*waiting, strict=True)
                    self._store.add(topic, np.array(times, np.int64), np.array(numbers))
                    waiting.clear()
        elif recorded is not None:
            for one in queues:
                while one and one[0][0] <= recorded.until_ns:
                    one.popleft()

    def _past_is_read(self, now: float) -> bool:
        """Whether a bag brings the past, or may soon."""
        recorded = self._recorded
        if recorded is None:
            return now - max(self._listens_since, self._waits_since) < _FOUND_S
        return not recorded.problem and (recorded.more or now - recorded.grew < _WAIT_S)

    def _source(self, now: float) -> str:
        """Return where what is shown is from: ``heard``, ``bag`` or ``samples``."""
        recorded, listens = self._recorded, self._listens_since > 0
        if recorded is not None and not recorded.problem and not listens:
            return "bag"
        too_fast = not listens and (self._graph.factor(self._tau) or 0.0) > FASTEST
        if too_fast and self._running and now - self._waits_since > _FOUND_S:
            return "samples"
        return "heard"

    # --- what is said of it ---------------------------------------------------------------------

    def _say(self, now: float) -> None:
        self._said = now
        recorded, source = self._recorded, self._source(now)
        notes = [self._problem] if now < self._problem_until else []
        if self._no_ros:
            notes.append(f"Only the recording is shown: {self._no_ros}.")
        if recorded is not None:
            if self._mode in ("live", "ended"):
                notes.append(self._show_incidents(recorded.bag))
            notes += [recorded.problem, recorded.progress]
        shown = self._shows_graph()
        if not shown and self._graph.mode(now) not in ("none", "ended"):
            notes.append(f"Another graph runs here; {self._bag} is shown.")
        if source == "samples":
            notes.append(
                "Shows samples: the run is too fast to be heard in full, and there is no recording "
                "of it here."
            )
        self._store.set_present(
            mode=self._mode, factor=self._graph.factor(self._tau) if self._running else None,
            source=source, note=" ".join(filter(None, notes)), graph_shown=shown,
        )
        self._store.look(now, time.time())

    def _show_incidents(self, bag: Path) -> str:
        """Show what was lost in a recorded run, read again when it has changed.

        Returns:
            What is wrong with that.
        """
        versions = [_version(bag.parent / name) for name in (INCIDENTS, SUMMARY)]
        if versions != self._incidents_read:
            self._incidents_read, self._no_incidents = versions, ""
            try:
                self._store.set_incidents(read_incidents_of(bag))
            except ValueError as error:
                self._store.set_incidents(())
                self._no_incidents = f"{error}."
        return self._no_incidents

    # --- stopping -------------------------------------------------------------------------------

    def _pump(self) -> str | None:
        """Return the pump node that a stop is for; None where there is none.

        Raises:
            StopFailedError: there are two.
        """
        now = time.monotonic()
        if not self._shows_graph():
            return None
        if two := self._graph.two_pumps(now):
            raise StopFailedError(
                f"Two nodes say that they are the pump's, {two}: which one has it is not known. "
                "Stop the pump at its drive's panel, and end the node that should not run."
            )
        node = self._graph.pump(now)
        return None if node is None else node.name

    def _prepare_stop(self) -> None:
        assert self._looker is not None
        with suppress(StopFailedError):
            self._looker.prepare_stop(self._pump())

    def _answer_stops(self) -> None:
        assert self._looker is not None
        with suppress(queue.Empty):
            while True:
                action, asked = self._asked.get_nowait()
                if not asked.set_running_or_notify_cancel():
                    continue
                try:
                    self._looker.prepare_stop(self._pump())
                    act = {
                        "stop": self._looker.stop_pump, "release": self._looker.release_pump,
                        "clear": self._looker.clear_fault,
                    }[action]
                    asked.set_result(act(_STOP_S))
                except Exception as error:  # it is the asker's
                    asked.set_exception(error)


def _version(path: Path) -> tuple[int, int] | None:
    """Return what changes when a file is written; None where there is none."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size
