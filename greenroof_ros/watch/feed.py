"""Feeds what is shown: from the graph that is there and from the bag that it writes.

A watcher must hold nobody up: see :mod:`greenroof_ros.graph.looker`. What it subscribes to costs
its publishers time in each tick all the same, so that it hears the numbers of a run only up to some
speed. Above it /diagnostics is all that it hears, and the rest comes from the bag, which a process
reads that gives way to all others of the machine.
"""

from __future__ import annotations

import json
import queue
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import suppress
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_text, shared_directory
from greenroof_ros.common.interface import read_topics
from greenroof_ros.experiment.incidents import INCIDENTS
from greenroof_ros.experiment.summary import SUMMARY, site_file_of
from greenroof_ros.graph.looker import DIAGNOSTICS, Looker, StopFailedError
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.watch import wire
from greenroof_ros.watch.bag_reader_process import FollowedBag
from greenroof_ros.watch.graph_state import GraphState
from greenroof_ros.watch.incident_rows import read_dated
from greenroof_ros.watch.recorded import Batch
from greenroof_ros.watch.ticks import Ticks
from greenroof_ros.watch.watched import Watched

# Up to how many times real time the numbers of a run are heard: 60 and its jitter.
FASTEST = 66.0
# How often the watcher looks at what came (s).
_LOOK_S = 0.05
# How often it says how the graph is (s).
_SAY_S = 0.25
# After so long (s) every publisher has found the watcher.
_MATCHED_S = 1.0
# How long what is heard waits for the bag to come up to it, so that nothing is missing between;
# the recorder of a live site writes every 10 s.
_WAIT_S = 30.0
# How long it may take until the recorder has said where its bag is (s): what is older than what is
# shown could not be shown any more.
_FOUND_S = 3.0
# A pause of this process (s) after which messages are missing.
_PAUSE_S = 2.0
# A shorter one, after which those that were not heard meanwhile may have spoken (s).
_OWN_PAUSE_S = 0.5
# For how long an error of the watcher's own is shown (s), and how long it rests after it.
_SHOWN_S, _REST_S = 60.0, 1.0
_STOP_S = 3.0
# Of one topic, how many messages wait for the bag.
_MOST_WAITING = 20_000
# Of one message of /diagnostics, how many statuses go on.
_STATUSES = 200

_CLOCK, _STATE, _PLAN = "/clock", "/pump/state", "/controller/plan"


class _Heard:
    """What was heard and is not yet shown, by topic."""

    def __init__(self) -> None:
        self.numbers: defaultdict[str, list[tuple[int, float]]] = defaultdict(list)
        self.forecasts: dict[str, tuple[int, bytes]] = {}
        self.plans: list[tuple[int, NDArray[np.float64]]] = []
        self.texts: list[tuple[str, int, str]] = []

    @property
    def many(self) -> bool:
        """Whether so much waits that it is better read from the bag."""
        counts = [len(self.plans), len(self.texts), *map(len, self.numbers.values())]
        return max(counts) > _MOST_WAITING

    def batch(self) -> Batch:
        """Return it as what is read from a bag."""
        batch = Batch(forecasts=self.forecasts, plans=self.plans, texts=self.texts)
        for topic, pairs in self.numbers.items():
            times, values = zip(*pairs, strict=True)
            batch.numbers[topic] = np.array(times, np.int64), np.array(values)
        return batch


class Feed:
    """Feeds a :class:`~greenroof_ros.watch.watched.Watched` for as long as it is entered."""

    def __init__(
        self, watched: Watched, namespace: str, *, bag: Path | None, site_file: Path | None
    ) -> None:
        """Begin with nothing.

        Args:
            watched: what is fed.
            namespace: of the graph, such as ``/site1``; empty for none.
            bag: to read; None for the one that the graph writes.
            site_file: by which levels are judged; None for the graph's own.

        Raises:
            ConfigurationError: the site file is wrong.
        """
        self._watched = watched
        self._namespace = namespace
        self._bag = None if bag is None else bag.resolve()
        self._site_file = site_file
        self._topics = read_topics()
        self._graph = GraphState(namespace)
        self._run = 0
        self._lock = threading.Lock()  # of the bag that is read
        self._recorded: FollowedBag | None = None
        self._ticks = Ticks()
        self._heard = _Heard()
        self._hearing = False  # what is heard is shown as it comes
        self._listens_since = 0.0
        self._complete_ns: int | None = None  # from then on nothing that is heard is missing
        self._mode = "none"
        self._live: bool | None = None  # the graph that is shown, or was shown last
        self._site: Path | None = None
        self._judged_by: Site | None = None
        self._tau = 1.0
        self._looked = self._awake = time.monotonic()
        self._said = self._waits_since = 0.0
        self._problem, self._problem_until = "", 0.0
        self._stops: queue.SimpleQueue[Future[str]] = queue.SimpleQueue()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._watch_graph, name="graph", daemon=True)
        self._looker: Looker | None = None
        self._no_ros = ""
        self._incidents_read: list[tuple[int, int] | None] = []
        self._no_incidents: list[str] = []
        self._judge_by(site_file or self._site_of_graph())

    def __enter__(self) -> Feed:
        """Join the graph.

        Raises:
            ConfigurationError: ROS 2 is not installed, and no bag was given.
        """
        try:
            self._looker = Looker(self._namespace, self._on_message)
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

    def stop_pump(self) -> str:
        """Have the pump held off, from any thread.

        Returns:
            What the pump node says.

        Raises:
            StopFailedError: it did not say that it holds the pump off.
        """
        asked: Future[str] = Future()
        self._stops.put(asked)
        if self._looker is not None:
            self._looker.wake()
        try:
            return asked.result(_STOP_S + 2.0)
        except FutureTimeoutError:
            asked.cancel()
            raise StopFailedError(
                "The watcher is busy: whether the pump stops is not known."
            ) from None

    # --- the graph ------------------------------------------------------------------------------

    def _watch_graph(self) -> None:
        while not self._closing.is_set():
            self._look()
        self._follow(None)
        if self._looker is not None:
            self._looker.close()

    def _note(self, error: Exception) -> None:
        self._problem = (
            f"Something could not be shown; all else goes on ({type(error).__name__}: {error})."
        )
        self._problem_until = time.monotonic() + _SHOWN_S

    def _look(self) -> None:
        """Take all that came, and show it; what fails of it keeps nothing else from being done."""
        failed = self._fails(self._hear)
        self._forgive_own_pause()
        now = time.monotonic()
        paused, self._looked = now - self._looked > _PAUSE_S, now
        failed |= self._fails(lambda: self._see_graph(now))
        if self._looker is not None:
            failed |= self._fails(self._prepare_stop)
            self._answer_stops()
        failed |= self._fails(lambda: self._show_heard(now, paused=paused))
        if now - self._said > _SAY_S:
            self._said = now
            failed |= self._fails(lambda: self._say(now))
        if failed:
            self._rest()

    def _fails(self, act: Callable[[], None]) -> bool:
        """Do something; what is wrong with it is shown."""
        try:
            act()
        except Exception as error:  # whatever it is, the others go on
            self._note(error)
            return True
        return False

    def _rest(self) -> None:
        """Wait after an error, which may come again at once, but not with a stop."""
        until = time.monotonic() + _REST_S
        while time.monotonic() < until and self._stops.empty() and not self._closing.is_set():
            self._closing.wait(_LOOK_S)

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
            self._run = self._graph.runs
            self._begin_anew()
        self._live = live
        if mode != self._mode:
            if self._mode == "none":
                self._waits_since = now
            self._mode = mode
            if mode == "ended" and self._recorded is not None:
                # A bag may be followed before anything says who commands.
                self._watched.set_recorded_controller(_controller_of(self._recorded.bag))
            self._say(now)  # before what comes: an account has other rules on a live site
        self._judge_by(self._site_file or self._site_of_graph())
        self._find_bag()
        if self._looker is not None:
            self._choose_topics(now)

    def _prepare_stop(self) -> None:
        assert self._looker is not None
        self._looker.prepare_stop(self._pump(time.monotonic()))

    def _shows_graph(self) -> bool:
        """Whether the graph that is there is shown: not where another one's bag was asked for."""
        if self._bag is None:
            return True
        written = self._graph.bag()
        return self._graph.records and written in (None, self._bag)

    def _shown_mode(self, now: float) -> str:
        mode = self._graph.mode(now)
        if self._bag is not None and (mode == "none" or not self._shows_graph()):
            mode = "ended"
        if mode == "ended" and self._mode in ("simulated", "loop", "live"):
            self._watched.add_event(time.time(), "The run ended.")
        return mode

    def _begin_anew(self) -> None:
        """Forget the run before, and what is known of its site."""
        self._forget()
        self._site = None
        self._watched.add_event(time.time(), "Another run began.")

    def _forget(self) -> None:
        """Forget all that is shown; it is read again where it is recorded."""
        self._stop_hearing()
        self._ticks = Ticks()
        self._follow(None)
        self._watched.begin_anew()

    def _find_bag(self) -> None:
        """Follow the bag that was asked for, or the one that the graph's recorder writes."""
        bag = self._bag or self._graph.bag()
        if bag is not None and (self._recorded is None or self._recorded.bag != bag):
            self._follow(bag)

    def _follow(self, bag: Path | None) -> None:
        """Follow another bag, or none."""
        # What the one before has still on its way is not shown any more.
        with self._lock:
            before, self._recorded = self._recorded, None
        if before is not None:
            before.close()
        self._incidents_read = []
        if bag is not None:
            namespace = self._namespace if self._bag is None else None
            self._watched.set_recorded_controller(_controller_of(bag))
            with self._lock:
                self._recorded = FollowedBag(bag, namespace, self._on_batch)

    def _on_batch(self, recorded: FollowedBag, batch: Batch) -> None:
        with self._lock:
            if recorded is self._recorded:
                self._add(batch)

    def _site_of_graph(self) -> Path | None:
        if self._shows_graph() and (site := self._graph.site()) is not None:
            return site
        if self._bag is not None:
            site = site_file_of(self._bag.parent)
            return site if site.is_file() else None
        return None

    def _judge_by(self, path: Path | None) -> None:
        """Judge levels by a site file, or by the paper's where there is none."""
        file = path or shared_directory() / "config" / "site.yaml"
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
            site = read_site(shared_directory() / "config" / "site.yaml")
        another, self._judged_by, self._tau = site != self._judged_by, site, site.tau
        self._watched.set_site(site, note)
        if another and self._recorded is not None:
            self._forget()  # what of it was taken was judged by another site

    def _choose_topics(self, now: float) -> None:
        """Subscribe to what the graph can bear."""
        assert self._looker is not None
        listens = self._listens_since > 0
        if self._mode == "live":
            wanted = True
        elif self._running:
            factor = self._graph.factor(self._tau)
            # A run that has not begun, or that stands, says nothing of its speed.
            wanted = listens if not factor else factor <= FASTEST
        else:
            wanted = False
        if wanted and not listens:
            live = self._mode == "live"
            self._looker.listen([
                name for name, topic in self._topics.items()
                if (topic.live and name != DIAGNOSTICS) or (topic.per_tick and not live)
            ])
            self._listens_since = now
        elif listens and not wanted:
            self._stop_hearing()

    def _pump(self, now: float) -> str | None:
        """Return the pump node that is shown, and that a stop is for; None where there is none."""
        return self._graph.pump(now) if self._shows_graph() else None

    def _two_pumps(self, now: float) -> str:
        """Return why nothing can be stopped from here although there is a pump node."""
        two = self._graph.two_pumps(now) if self._shows_graph() else ""
        return two and (
            f"Two nodes say that they are the pump's, {two}: which one has it is not known. Stop "
            "the pump at its drive's panel, and end the node that should not run."
        )

    def _stop_hearing(self) -> None:
        self._show_heard_now()
        if self._looker is not None:
            self._looker.listen(())
        self._listens_since = 0.0
        self._wait_for_bag()

    def _wait_for_bag(self) -> None:
        """Show what is heard from now on when the bag has come up to it."""
        self._hearing = False
        self._complete_ns = None
        self._heard = _Heard()
        self._waits_since = time.monotonic()

    def _on_message(self, name: str, message: bytes, number: int | None, arrived_ns: int) -> None:
        """Take a message that came; one that cannot be taken keeps none of the others away."""
        try:
            self._forgive_own_pause()
            self._take(name, message, number, arrived_ns)
        except Exception as error:  # whatever somebody else may have sent
            self._note(error)

    def _forgive_own_pause(self) -> None:
        """Have no node taken for silent because this process stood still."""
        before, self._awake = self._awake, time.monotonic()
        if self._awake - before > _OWN_PAUSE_S:
            self._watched.forgive(self._awake - before)

    def _take(self, name: str, message: bytes, number: int | None, arrived_ns: int) -> None:
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
                stamp = self._ticks.time(
                    name, number, from_tick_0=self._graph.begins_with_run(topic)
                )
        if not stamp:
            return
        if name == _PLAN:
            rows = wire.rows(message)
            if rows is not None and len(rows):
                self._heard.plans.append((stamp, rows))
        elif topic.type.endswith("MultiArray"):
            self._heard.forecasts[name] = stamp, message
        elif topic.type.endswith("String"):
            text = wire.text(message)
            if text is not None:
                self._heard.texts.append((name, stamp, text))
        else:
            value = wire.number(message)
            if value is not None:
                self._heard.numbers[name].append((stamp, value))

    def _on_diagnostics(self, message: bytes, arrived_ns: int) -> None:
        found = wire.statuses(message)
        if found is None:
            return
        stamp, statuses = found
        statuses.sort(key=lambda status: not self._graph.own(status))
        self._graph.hear(stamp, arrived_ns / 1e9, statuses, time.monotonic(), self._tau)
        if self._shows_graph():
            own = bool(statuses) and self._graph.own(statuses[0])
            self._watched.add_statuses(
                time.monotonic(), statuses[:_STATUSES], stamp if own else None
            )

    def _show_heard(self, now: float, *, paused: bool) -> None:
        """Show what was heard, unless the bag has yet to come up to it."""
        if not self._listens_since:
            if self._source(now) == "samples" and self._graph.samples is not None:
                time_ns, values = self._graph.samples
                for topic, value in values.items():
                    self._watched.add(topic, np.array([time_ns]), np.array([value]))
            return
        missing, self._ticks.lost = self._ticks.lost or paused, False
        if (missing and self._recorded is not None) or self._heard.many:
            self._wait_for_bag()  # which has it
        newest = time.time_ns() if self._mode == "live" else self._ticks.newest_ns
        if self._complete_ns is None:
            if now - max(self._listens_since, self._waits_since) < _MATCHED_S:
                return
            self._complete_ns = newest
        if not self._hearing:
            recorded = self._recorded
            waited = now - self._waits_since
            self._hearing = (
                waited > _FOUND_S if recorded is None
                else recorded.until_ns >= self._complete_ns
                or (waited > (_FOUND_S if recorded.problem else _WAIT_S) and not recorded.more)
            )
        self._show_heard_now()

    def _show_heard_now(self) -> None:
        """Show what was heard; while the bag is waited for, the newest of it alone."""
        if not self._hearing:
            self._add_forecasts(self._heard.forecasts)
            for time_ns, plan in self._heard.plans[-1:]:
                self._watched.preview_plan(time_ns, plan)
            for topic, pairs in self._heard.numbers.items():
                self._watched.preview(topic, *pairs[-1])
        else:
            heard, self._heard = self._heard, _Heard()
            self._add(heard.batch())

    def _source(self, now: float) -> str:
        """Return where what is shown is from: ``heard``, ``bag`` or ``samples``."""
        recorded = self._recorded
        if recorded is not None and not self._hearing and not recorded.problem:
            return "bag"
        too_fast = not self._listens_since and (self._graph.factor(self._tau) or 0.0) > FASTEST
        if too_fast and self._running and now - self._waits_since > _FOUND_S:
            return "samples"
        return "heard"

    @property
    def _running(self) -> bool:
        """Whether a simulation runs."""
        return self._mode in ("simulated", "loop")

    def _say(self, now: float) -> None:
        notes = []
        if now < self._problem_until:
            notes.append(self._problem)
        if self._no_ros:
            notes.append(f"Only the recording is shown: {self._no_ros}.")
        recorded, source = self._recorded, self._source(now)
        if recorded is not None and self._mode in ("live", "ended"):
            notes += self._show_incidents(recorded.bag)
        if recorded is not None:
            notes += [note for note in (recorded.problem, recorded.progress) if note]
        if not self._shows_graph() and self._graph.mode(now) not in ("none", "ended"):
            notes.append(f"Another graph runs here; {self._bag} is shown.")
        if source == "samples":
            notes.append(
                "Shows samples: the run is too fast to be heard in full, and there is no recording "
                "of it here."
            )
        self._watched.set_pump(self._pump(now), self._two_pumps(now))
        factor = self._graph.factor(self._tau) if self._running else None
        self._watched.set_present(
            mode=self._mode, factor=factor, source=source, note=" ".join(notes)
        )
        self._watched.look(now, time.time())

    def _show_incidents(self, bag: Path) -> list[str]:
        """Show what was lost in a recorded run, read again when it has changed.

        Returns:
            What is wrong with that.
        """
        versions = [_version(bag.parent / name) for name in (INCIDENTS, SUMMARY)]
        if versions != self._incidents_read:
            self._incidents_read, self._no_incidents = versions, []
            try:
                self._watched.set_incidents(read_dated(bag))
            except ValueError as error:
                self._watched.set_incidents(())
                self._no_incidents = [f"{error}."]
        return self._no_incidents

    def _answer_stops(self) -> None:
        assert self._looker is not None
        with suppress(queue.Empty):
            while True:
                asked = self._stops.get_nowait()
                if not asked.set_running_or_notify_cancel():
                    continue
                now = time.monotonic()
                try:
                    if two := self._two_pumps(now):
                        raise StopFailedError(two)
                    self._looker.prepare_stop(self._pump(now))
                    asked.set_result(self._looker.stop_pump(_STOP_S))
                except Exception as error:  # it is the asker's
                    asked.set_exception(error)
                self._looked = time.monotonic()

    def _add(self, batch: Batch) -> None:
        """Take a batch; numbers last: they move now on, and its plans are there by then."""
        self._add_forecasts(batch.forecasts)
        for time_ns, plan in batch.plans:
            self._watched.add_plan(time_ns, plan)
        for topic, time_ns, text in batch.texts:
            self._watched.add_text(topic, time_ns, text)
        for topic, (times, values) in batch.numbers.items():
            self._watched.add(topic, times, values)

    def _add_forecasts(self, forecasts: dict[str, tuple[int, bytes]]) -> None:
        for topic, (time_ns, message) in forecasts.items():
            rows = wire.rows(message)
            if rows is not None:
                self._watched.add_forecast(topic, time_ns, rows)


def _version(path: Path) -> tuple[int, int] | None:
    """Return what changes when a file is written; None where there is none."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size


def _controller_of(bag: Path) -> str:
    """Return who commanded in a recorded run, by the summary beside its bag; empty: unknown."""
    try:
        name = json.loads(read_text(bag.parent / SUMMARY))["controller"]
    except (ConfigurationError, ValueError, KeyError, TypeError):
        return ""
    return name if isinstance(name, str) else ""
