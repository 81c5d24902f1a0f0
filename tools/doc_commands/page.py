"""Runs a page's blocks one after the other in a copy of the checkout."""

from __future__ import annotations

import os
import re
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from doc_commands.blocks import Block
from doc_commands.terminal import Outcome, Terminal
from places import CHECKOUT

# Marks the processes of a page, which all inherit it, to find those that are left.
_SESSION = "GREENROOF_ROS_DOC_COMMANDS"
_EXIT_S = 10.0


def copy_of_checkout(to: Path) -> None:
    """Copy the files that a clone has; ``.venv`` is a link to the checkout's."""
    hidden = shutil.ignore_patterns(".?*", "__pycache__", "_build")
    made = shutil.ignore_patterns("runs", "studies", "build", "install", "log")
    shutil.copytree(CHECKOUT, to, ignore=lambda folder, names: (
        hidden(folder, names) | (made(folder, names) if Path(folder) == CHECKOUT else set())
    ))
    (to / ".venv").symlink_to(Path(sys.prefix))


def run_page(
    blocks: Sequence[Block], directory: Path, domain: int
) -> Iterator[tuple[Block, Outcome | None]]:
    """Run the blocks of a page.

    Args:
        blocks: of the page, in order.
        directory: an empty one, for the copy of the checkout and the home directory.
        domain: ROS domain of everything that is started.

    Yields:
        Each block and its outcome; None if it is not run.
    """
    checkout, home = directory / "greenroof_ros", directory / "home"
    home.mkdir()
    copy_of_checkout(checkout)
    environment = {
        **{name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        "PATH": f"{checkout}/.venv/bin:{os.environ['PATH']}", "HOME": str(home),
        "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "TERM": "xterm-256color", "COLUMNS": "120", _SESSION: str(directory),
    }
    terminal = Terminal(checkout, environment)
    last: tuple[Block, Outcome] | None = None
    try:
        for block in blocks:
            if last is not None:
                yield last
                last = None
            if block.note.not_run:
                yield block, None
            else:
                last = block, _run(block, terminal)
    finally:
        failures = terminal.close()
        failures += [f"left running: {process}" for process in _running_in(directory)]
        if last is not None:
            block, outcome = last
            last = block, replace(outcome, failures=[*outcome.failures, *failures])
    if last is not None:
        yield last


def _run(block: Block, terminal: Terminal) -> Outcome:
    note = block.note
    before = terminal.run(note.before)
    if before.failures:
        return before
    outcome = terminal.run(block.commands, note.ready, note.then_s)
    after = terminal.run(note.after)
    wrong = [f"printed {text!r}" for text in note.says_not if re.search(text, outcome.output)]
    return replace(outcome, failures=[*outcome.failures, *wrong, *after.failures])


def _running_in(directory: Path) -> list[str]:
    """Return the processes of a page that still run after some time."""
    mark = f"{_SESSION}={directory}".encode()
    until = time.monotonic() + _EXIT_S
    while True:
        running = []
        for entry in Path("/proc").glob("[0-9]*"):
            try:
                if mark in (entry / "environ").read_bytes().split(b"\0"):
                    words = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
                    running.append(f"{entry.name} {words}")
            except OSError:  # it has ended, or is another user's
                continue
        if not running or time.monotonic() > until:
            return running
        time.sleep(0.2)
