"""An exchange that is asked for a speed again and again, as by the pump node."""

from __future__ import annotations

import threading

from simulators import until

from greenroof_ros.live.devices.exchange import DriveExchange, DriveSnapshot


class Asking:
    """Asks from its beginning on.

    Attributes:
        exchange: not yet started.
        speed: the speed asked for; None for off.
    """

    def __init__(self, exchange: DriveExchange) -> None:
        self.exchange = exchange
        self.speed: float | None = None
        self._ended = threading.Event()
        self._hand = threading.Thread(target=self._ask, daemon=True)
        self._hand.start()

    def _ask(self) -> None:
        while not self._ended.wait(0.05):
            self.exchange.request_speed(None if self.now.start_failed else self.speed)

    def ask_no_more(self) -> None:
        self._ended.set()
        self._hand.join()

    @property
    def now(self) -> DriveSnapshot:
        return self.exchange.snapshot

    def connect(self) -> None:
        self.exchange.start()
        until(lambda: self.now.connected)
