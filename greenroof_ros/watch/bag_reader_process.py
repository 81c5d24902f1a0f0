"""A process that follows a bag and hands on what it reads.

It gives way to all others of the machine. A thread could not: one that waits for the processor
while it holds Python's lock stops the page as well, on a busy machine for tens of seconds.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from greenroof_ros.common.processes import asked_to_end_with_this, end_with_parent
from greenroof_ros.watch.recorded import Batch, Recorded

# How often it looks at a bag of which it has read all (s).
_LOOK_S = 0.5


class FollowedBag:
    """A bag that is read by a process of its own.

    Attributes:
        bag: its directory.
        until_ns: all up to then was handed on (ns since 1970).
        problem: why not all of it can be read; empty where it can.
        progress: how far it has been read, where that takes long; otherwise empty.
        more: whether there is more to be read.
        replaced: whether it is another bag by now.
    """

    def __init__(
        self, bag: Path, namespace: str | None, on_batch: Callable[[FollowedBag, Batch], None]
    ) -> None:
        """Start to read.

        Args:
            bag: its directory.
            namespace: of its topics; None for that of the first level.
            on_batch: called in a thread of its own with each batch.
        """
        self.bag = bag
        self.until_ns = 0
        self.problem = self.progress = ""
        self.more, self.replaced = True, False
        self._on_batch = on_batch
        self._closed = False
        arguments = [str(bag)] if namespace is None else [str(bag), namespace]
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, *arguments],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            env=asked_to_end_with_this(),
        )
        self._thread = threading.Thread(target=self._receive, name="bag", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the process; nothing is handed on afterwards."""
        self._closed = True
        self._process.kill()

    def _receive(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as stream:
            while not self._closed:
                try:
                    batch, *state = pickle.load(stream)  # noqa: S301 - from main below alone
                    self._on_batch(self, batch)
                except Exception as error:  # whatever ended it, it is shown
                    self.problem = (
                        "The recording is not read any more, and what it has of later is missing "
                        f"({type(error).__name__}{f': {error}' if str(error) else ''})."
                    )
                    self.more = False
                    break
                self.until_ns = batch.newest_ns
                self.problem, self.progress, self.more, self.replaced = state
        self._process.kill()
        self._process.wait()


def main() -> None:
    """Read a bag, and write what is in it to the standard output."""
    end_with_parent()
    with suppress(AttributeError, OSError):  # not Linux, or a container that forbids it
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    bag, *namespace = sys.argv[1:]
    recorded = Recorded(Path(bag), *namespace)
    last: tuple[object, ...] = ()
    with suppress(BrokenPipeError, KeyboardInterrupt):
        while True:
            batch = recorded.read()
            state = (recorded.problem, recorded.progress, recorded.more, recorded.replaced)
            if (state, recorded.newest_ns) != last or batch.texts:
                last = (state, recorded.newest_ns)
                pickle.dump((batch, *state), sys.stdout.buffer)
                sys.stdout.buffer.flush()
            if not recorded.more:
                time.sleep(_LOOK_S)


if __name__ == "__main__":
    main()
