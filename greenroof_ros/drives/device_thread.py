"""A thread that keeps up with one device on Modbus, through whatever goes wrong there."""

from __future__ import annotations

import logging
import math
import threading
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

from greenroof_ros.drives.modbus_line import DriveError

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Known:
    """What is known of a device at one moment.

    Attributes:
        read_at: when it last said something (s, `time.monotonic`).
        problem: what went wrong last and is not over; empty for nothing.
    """

    read_at: float = -math.inf
    problem: str = "not yet connected"


K = TypeVar("K", bound=Known)


class DeviceThread(ABC, Generic[K]):
    """Does one step after another with a device until it is closed.

    Whatever a step comes to, another one follows. Nothing here raises into the caller: what went
    wrong is in `snapshot`.
    """

    def __init__(self, what: str, known: K) -> None:
        """Prepare it.

        Args:
            what: is done, for messages.
            known: of the device, before anything is.
        """
        self._what, self._snapshot, self._lock = what, known, threading.Lock()
        self._closing = self._done = False
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._work, name=what, daemon=True)

    @property
    def snapshot(self) -> K:
        """What is known now."""
        return self._snapshot

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def _end(self, within_s: float) -> bool:
        """Have it end; tell whether it has within a time (s)."""
        self._closing = True
        self._wake.set()
        if self._thread.ident is not None:
            self._thread.join(within_s)
        return not self._thread.is_alive()

    # --- in the thread ----------------------------------------------------------------------------

    @abstractmethod
    def _step(self) -> None:
        """Do what is to be done now, and wait until the next is due.

        Raises:
            DriveError: it failed.
        """

    @abstractmethod
    def _lost(self, error: Exception, problem: str) -> None:
        """Take in that a step failed, and let go of the connection."""

    def _work(self) -> None:
        while not self._done:
            try:
                try:
                    self._step()
                except DriveError as error:
                    self._lost(error, str(error))
                except Exception as error:  # whatever it is, the next step begins anew
                    _log.exception("%s failed", self._what)
                    self._lost(error, f"{self._what} failed: {error!r}")
            except Exception as error:
                self._update(problem=f"{self._what} failed: {error!r}")

    def _update(self, **changes: Any) -> None:
        with self._lock:
            self._snapshot = replace(self._snapshot, **changes)

    def _pause(self, seconds: float) -> None:
        """Wait, at most until something is asked for."""
        self._wake.wait(max(0.0, seconds))
        self._wake.clear()

    def _pause_until(self, due: float) -> None:
        """Wait until a time (s, `time.monotonic`), whatever is asked for but the end."""
        while not self._closing and (rest := due - time.monotonic()) > 0:
            self._pause(rest)
