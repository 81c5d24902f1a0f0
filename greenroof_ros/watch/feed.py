"""Feed that passes messages from a running graph to the store, and requests to its nodes.

A watcher must not slow down the graph: see :mod:`greenroof_ros.watch.graph_client`. Each of a
watcher's subscriptions nevertheless costs the publisher time in every tick, so the watcher receives
the values of a run only up to a certain speed. Above this speed, it receives only /diagnostics and
/alarms.
"""

from __future__ import annotations

import threading
import time
import traceback
from functools import partial
from pathlib import Path
from typing import Any

from greenroof_ros.base.disk import DISK
from greenroof_ros.base.standard_error import print_seldom
from greenroof_ros.interface.states import PUMP
from greenroof_ros.watch.graph_client import (
    ALARMS,
    CLOCK,
    DIAGNOSTICS,
    GraphClient,
    RequestError,
    read_message,
)
from greenroof_ros.watch.lines import read_histories, write_histories
from greenroof_ros.watch.store import FASTEST, TOPICS, GraphStore

# Interval at which the watcher receives new messages (s).
_POLL_S = 0.1
_STOP_S = 3.0
# For how long the valve is opened (s).
_OPEN_S = 1800.0
# Interval at which the past of a live site is saved, and longest wait at the end for this (s).
_SAVE_S, _SAVED_S = 600.0, 10.0


class Feed:
    """A context manager that feeds a :class:`~greenroof_ros.watch.store.GraphStore`."""

    def __init__(self, store: GraphStore, past_file: Path | None = None) -> None:
        """Prepare the feed without joining the graph.

        Args:
            store: the store to feed.
            past_file: file that preserves the history of a live site across restarts; None for no
                file.
        """
        self._store, self._past_file = store, past_file
        self._saved_at = time.monotonic()
        self._requesting = threading.Lock()  # held by the thread that makes a request
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._watch_graph, name="graph", daemon=True)
        self._client: GraphClient | None = None

    def __enter__(self) -> Feed:
        """Join the graph.

        Raises:
            ConfigurationError: if ROS 2 is not installed.
        """
        self._client = GraphClient(self._store.namespace, self._on_message)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the graph."""
        self._closing.set()
        self._thread.join(2.0)
        self._save()
        DISK.wait(_SAVED_S)

    def request_action(self, action: str, **request: Any) -> str:
        """Request an action; callable from any thread.

        Args:
            action: name of the action, as in
                :meth:`greenroof_ros.watch.graph_client.GraphClient.request`; for the valve,
                ``valve_close``, ``valve_release`` or ``valve_open``, which is for 30 minutes.
            request: parameters of the action.

        Returns:
            The node's answer.

        Raises:
            RequestError: if the node does not confirm the request.
        """
        role, _, name = action.rpartition("_")
        if name == "open":
            request["until"] = time.time() + _OPEN_S
        if self._client is None or not self._requesting.acquire(timeout=2 * _STOP_S):
            raise RequestError(
                "The watcher is busy, so no request was sent, and nothing was done."
            )
        try:
            return self._client.request(name, _STOP_S, role or PUMP, **request)
        finally:
            self._requesting.release()

    # --- the graph ------------------------------------------------------------------------------

    def _watch_graph(self) -> None:
        """Receive messages and update the store until the end, whatever fails."""
        assert self._client is not None
        while not self._closing.wait(_POLL_S):
            try:
                self._client.receive()
                self._update_store()
            except Exception:
                print_seldom("step", traceback.format_exc())
        with self._requesting:
            self._client.close()

    def _update_store(self) -> None:
        """Update what the store knows of the graph as a whole, and subscribe accordingly."""
        assert self._client is not None
        store, now, was_live = self._store, time.monotonic(), self._store.mode == "live"
        store.update(now, time.time())
        is_live = store.mode == "live"
        if is_live and not was_live and self._past_file is not None:
            past = read_histories(self._past_file)  # the disk may be slow
            with store.lock:
                store.past |= past
        wanted = is_live or (store.mode == "simulated" and store.factor <= FASTEST)
        topics = TOPICS if is_live else (*TOPICS, CLOCK)
        self._client.subscribe(topics if wanted else ())
        if self._requesting.acquire(blocking=False):  # a request itself finds the pumps
            try:
                store.offered = self._client.find_nodes()
            finally:
                self._requesting.release()
        if now - self._saved_at >= _SAVE_S:
            self._save()

    def _on_message(self, name: str, message: bytes, time_ns: int) -> None:
        content, now = read_message(name, message), time.monotonic()
        if content is None:
            return
        if name == ALARMS:
            self._store.add_alarms(now, content[1])
        elif name == DIAGNOSTICS:
            self._store.add_statuses(now, *content)
        else:
            self._store.add(name, time_ns, content)

    def _save(self) -> None:
        """Save the history of a live site, without waiting for the disk."""
        self._saved_at = time.monotonic()
        if self._past_file is None or self._store.mode != "live":
            return
        with self._store.lock:
            rows = {name: past.rows.copy() for name, past in self._store.past.items()}
        size = sum(each.nbytes for each in rows.values())
        DISK.do(partial(write_histories, self._past_file, rows), size)
