"""What both simulators do as programs: open their ports, say so, and go on until they are ended."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable
from typing import Protocol


class Bench(Protocol):
    """What runs a simulator."""

    async def start(self) -> None:
        """Open all ports."""

    async def run(self, ended: asyncio.Event) -> None:
        """Let time pass until the end, and close them."""


def serve(bench: Bench, ready: Callable[[], None]) -> None:
    """Run a simulator until Ctrl-C or SIGTERM.

    Args:
        bench: what runs it.
        ready: called when all ports are open.

    Raises:
        ConfigurationError: one of them cannot be opened.
    """

    async def go() -> None:
        ended = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, ended.set)
        await bench.start()
        ready()
        await bench.run(ended)

    asyncio.run(go())
