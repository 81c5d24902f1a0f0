"""Feed that passes messages from a running graph to the store and requests to the pump node.

A watcher must not slow down the graph: see :mod:`greenroof_ros.watch.graph_client`. Each of a
watcher's subscriptions nevertheless costs the publisher time in every tick, so the watcher receives
the values of a run only up to a certain speed. Above this speed, it receives only /diagnostics and
/alarms.
"""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

from greenroof_ros.base.disk import DISK
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import default_site_file
from greenroof_ros.base.standard_error import print_seldom
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.site.file import read_site
from greenroof_ros.watch import wire
from greenroof_ros.watch.graph_client import ALARMS, DIAGNOSTICS, GraphClient, PumpRequestError
from greenroof_ros.watch.history import read_histories, write_histories
from greenroof_ros.watch.store import GraphStore

# Speed of the fastest run, in multiples of real time, whose numbers are received: 60 and some
# jitter. A run that was held up on a busy machine is faster for a while.
FASTEST = 66.0
_CATCHING_UP = 2.0
# Interval at which the watcher receives new messages, and at which it updates the state of the
# graph (s).
_POLL_S = 0.1
# If this process pauses for longer than this (s), the silence of other nodes means nothing.
_OWN_PAUSE_S = 0.5
# How long the watcher rests after an error of its own (s).
_REST_S = 1.0
_STOP_S = 3.0
# Interval at which the past of a live site is saved, and longest wait at the end for this (s).
_SAVE_S, _SAVED_S = 600.0, 10.0

CLOCK, CLOCK_TYPE = "/clock", "rosgraph_msgs/msg/Clock"


class Feed:
    """A context manager that feeds a :class:`~greenroof_ros.watch.store.GraphStore`."""

    def __init__(self, store: GraphStore, past_file: Path | None = None) -> None:
        """Prepare the feed without joining the graph.

        Args:
            store: the store to feed.
            past_file: file that preserves the history of a live site across restarts; None for no
                file.
        """
        self._store = store
        self._graph = store.graph
        self._past_file = past_file
        self._topics = read_topics()
        self._runs = 0
        self._subscribed = False
        self._site_file: Path | None = None
        self._awake = self._saved_at = time.monotonic()
        self._requesting = threading.Lock()  # held by the thread that makes a request
        self._requesting.acquire()  # until the graph is joined
        # The stops that are waiting or in progress, and the last one; each is a separate object.
        self._stops, self._last_stop = set[object](), object()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._watch_graph, name="graph", daemon=True)
        self._client: GraphClient | None = None
        self._set_site()

    def __enter__(self) -> Feed:
        """Join the graph.

        Raises:
            ConfigurationError: if ROS 2 is not installed.
        """
        self._client = GraphClient(self._store.namespace, self._on_message)
        self._requesting.release()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Leave the graph."""
        self._closing.set()
        self._thread.join(2.0)
        self._save()
        DISK.wait(_SAVED_S)

    def request_action(self, action: str, **request: Any) -> str:
        """Request a hold, a release, the clearing of a fault or a dose; callable from any thread.

        Args:
            action: name of the action, as in
                :meth:`greenroof_ros.watch.graph_client.GraphClient.request`.
            request: parameters of the action.

        Returns:
            The pump node's answer.

        Raises:
            PumpRequestError: if the pump node does not confirm the request.
        """
        this = object()
        if action == "stop":
            self._last_stop = this
            self._stops.add(this)
        last_stop = self._last_stop
        if not self._requesting.acquire(timeout=2 * _STOP_S + 0.5):
            self._stops.discard(this)
            raise PumpRequestError(
                "The watcher is busy, so no request was sent to the pump node and nothing was done."
            )
        try:
            assert self._client is not None
            if action != "stop":
                # The action would undo a stop, or keep one waiting.
                if self._last_stop is not last_stop or self._stops:
                    raise PumpRequestError("Nothing was done: someone is stopping the pump.")
                with self._store.lock:
                    two = self._store.two_pumps
                if two:  # a stop goes to each of them
                    raise PumpRequestError(two)
            return self._client.request(action, _STOP_S, **request)
        finally:
            self._stops.discard(this)
            self._requesting.release()

    # --- the graph ------------------------------------------------------------------------------

    def _watch_graph(self) -> None:
        """Receive messages and update the store, even if one of the steps fails."""
        assert self._client is not None
        steps = self._excuse_own_pause, self._client.receive, self._find_pumps, self._update_graph
        while not self._closing.is_set():
            if sum(map(_fails, steps)):  # it may fail again immediately
                self._closing.wait(_REST_S)
            time.sleep(_POLL_S)
        self._requesting.acquire()
        self._client.close()

    def _excuse_own_pause(self) -> None:
        """Exclude a pause in this process from the time for which the nodes have been silent."""
        before, self._awake = self._awake, time.monotonic()
        if self._awake - before > _OWN_PAUSE_S:
            self._store.excuse_silence(self._awake - before)

    def _find_pumps(self) -> None:
        assert self._client is not None
        if not self._requesting.acquire(blocking=False):
            return  # a request itself finds them
        try:
            pumps = self._client.find_pumps()
        finally:
            self._requesting.release()
        with self._store.lock:
            self._graph.offered = pumps

    def _update_graph(self) -> None:
        store, was_live, now = self._store, self._graph.live, time.monotonic()
        with store.lock:
            mode = self._graph.update(now)
        if self._graph.runs != self._runs:
            self._runs = self._graph.runs
            self._graph.forget_clock()
            store.reset()
            store.add_event("Another run has started.")
        if self._graph.live and not was_live:
            self._load()
        if mode == "ended" and store.mode not in ("none", "ended"):
            store.add_event("The run has ended.")
        self._set_site()
        factor = self._graph.factor(store.site.tau) if mode == "simulated" else None
        note = "" if self._subscribed or (factor or 0.0) <= FASTEST else (
            "This run is faster than 60 times real time, so its values are not shown. Use "
            "greenroof report after the run."
        )
        store.set_present(mode=mode, factor=factor, note=note)
        store.update(now, time.time())
        self._choose_topics(mode, factor)
        if now - self._saved_at >= _SAVE_S:
            self._save()

    def _set_site(self) -> None:
        """Set the site whose parameters are used to judge levels: the graph's or the paper's."""
        file = self._graph.site(time.monotonic()) or default_site_file()
        if file == self._site_file:
            return
        self._site_file, note = file, "" if self._graph.site(time.monotonic()) else (
            "Levels are judged by the parameters of the paper's site, config/site.yaml."
        )
        try:
            site = read_site(file)
        except ConfigurationError as error:
            site = read_site(default_site_file())
            note = (
                "The site file cannot be read; levels are judged by the parameters of the "
                f"paper's site: {error}"
            )
        self._store.set_site(site, note)

    def _choose_topics(self, mode: str, factor: float | None) -> None:
        """Subscribe to as many topics as a graph of this kind and speed can serve."""
        assert self._client is not None
        live = mode == "live"
        # The speed of a run that has not begun, or that is not moving, is unknown.
        fastest = _CATCHING_UP * FASTEST if self._subscribed else FASTEST
        wanted = live or (
            mode == "simulated" and (factor <= fastest if factor else self._subscribed)
        )
        if wanted == self._subscribed:
            return
        self._client.subscribe([
            name for name, topic in self._topics.items()
            if (topic.per_tick and not live) or (live and topic.live)
        ] if wanted else ())
        self._subscribed = wanted
        self._graph.forget_clock()

    # --- incoming messages ----------------------------------------------------------------------

    def _on_message(self, *message: Any) -> None:
        """Receive a message; after a message that cannot be processed, continue with the next."""
        _fails(partial(self._receive_message, *message))

    def _receive_message(
        self, name: str, message: bytes, number: int | None, arrived_ns: int
    ) -> None:
        store = self._store
        if name in (DIAGNOSTICS, ALARMS):
            if (received := wire.read_reports(message)) is not None:
                stamp_ns, statuses = received
                if name == ALARMS:
                    store.add_alarms(time.monotonic(), stamp_ns, statuses)
                else:
                    store.add_statuses(time.monotonic(), statuses, stamp_ns)
        elif name == CLOCK:
            if (time_ns := wire.read_value(CLOCK_TYPE, message)) is not None:
                self._graph.receive_clock(number, time_ns)
        elif time_ns := self._graph.time_of(self._topics[name], number, arrived_ns):
            store.receive(name, time_ns, message)

    # --- the past of a live site ----------------------------------------------------------------

    def _load(self) -> None:
        """Load the history of a live site; if the file cannot be read, the charts start empty."""
        if self._past_file is None:
            return
        store, file = self._store, self._past_file
        try:
            past = read_histories(file, store.past, time.time_ns())
        except (OSError, ValueError) as error:
            print(f"the charts start empty: {file} cannot be read ({error})", file=sys.stderr)
            return
        with store.lock:
            store.past |= past

    def _save(self) -> None:
        """Save the history of a live site, without waiting for the disk."""
        self._saved_at = time.monotonic()
        if self._past_file is None or not self._graph.live:
            return
        with self._store.lock:
            rows = {name: past.rows.copy() for name, past in self._store.past.items()}
        size = sum(each.nbytes for each in rows.values())
        DISK.do(partial(_write, self._past_file, rows), size)


def _fails(act: Callable[[], None]) -> bool:
    """Carry out a step; if it fails, print why, and return True."""
    try:
        act()
    except Exception:  # whatever the error, the others go on
        print_seldom("step", traceback.format_exc())
        return True
    return False


def _write(file: Path, rows: Any) -> None:
    try:
        write_histories(file, rows)
    except OSError as error:
        print(f"the history cannot be saved: {file}: {error.strerror or error}", file=sys.stderr)
