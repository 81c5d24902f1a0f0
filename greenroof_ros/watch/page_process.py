"""A page of a run, served by a process of its own; a run neither waits for it nor fails with it."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from greenroof_ros.common.processes import child_environment
from greenroof_ros.common.standard_error import print_line

# How long the watcher may take to end (s); then it is killed.
_ENDING_S = 3.0


@contextlib.contextmanager
def watcher(namespace: str, site_file: Path) -> Iterator[None]:
    """Serve a page during a run; print the watcher's output, which begins with the page's address.

    The watcher ends with the run, however that ends. If it cannot start or ends early, a line says
    so, and the run goes on.

    Args:
        namespace: of the graph.
        site_file: the site file by which levels are judged.
    """
    options = ["--site", str(site_file), *(["--namespace", namespace] if namespace else [])]
    process = subprocess.Popen(
        [sys.executable, "-m", "greenroof_ros", "watch", *options],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        errors="replace",
        start_new_session=True,  # Ctrl-C is for the run, which ends the watcher
        env=child_environment(),
    )
    ending = threading.Event()
    printer = threading.Thread(target=_print_output, args=(process, ending), daemon=True)
    printer.start()
    try:
        yield
    finally:
        ending.set()
        process.terminate()
        try:
            process.wait(_ENDING_S)
        except subprocess.TimeoutExpired:
            process.kill()
        printer.join(_ENDING_S)


def _print_output(process: subprocess.Popen[str], ending: threading.Event) -> None:
    """Print a watcher's output, and a line if it ended without being asked to."""
    assert process.stdout is not None
    for line in process.stdout:
        if not ending.is_set():
            print_line(f"watch: {line.rstrip()}")
    code = process.wait()
    if not ending.is_set():
        how = f"exit code {code}" if code >= 0 else signal.Signals(-code).name
        print_line(f"watch: the page has ended ({how}); the run goes on")
