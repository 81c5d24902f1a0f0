"""The command blocks of README and documentation, run as written: a sample of the pages.

``make doc-commands`` runs all of them: each page in a copy of the checkout and in one shell, its
blocks in order, as a reader types them with ``.venv`` active. A command that never ends gets Ctrl-C
as soon as it is ready. ``tools/doc_commands/notes.yaml`` lists what else a block needs, and why
some are not run.
"""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest
from doc_commands.blocks import PAGES, Block, Note, blocks_of, read_notes, untagged
from doc_commands.page import run_page

NOTES = read_notes()
# The page with which a new user's site begins.
RUN = PAGES if os.environ.get("GREENROOF_ROS_TEST_DOCS") else ["doc/howto/operate-a-live-site.md"]
FAILURES = {
    "python -c 'raise SystemExit(3)'\ntrue\n": (Note(""), "exit code 3: python"),
    "sh -c 'exit 4' &\nsleep 1\n": (Note(""), "Exit 4"),
    "echo ready\n": (Note("", ready=["ready"], then_s=20.0), "ended before its Ctrl-C"),
    "echo loss\n": (Note("", says_not=["loss"]), "printed 'loss'"),
}


def test_blocks_of_commands_report_it() -> None:
    assert {page: lines for page in PAGES if (lines := untagged(page))} == {}


def test_every_note_is_of_a_block() -> None:
    for page, notes in NOTES.items():
        blocks = blocks_of(page, NOTES)
        for note in notes:
            (block,) = [each for each in blocks if each.note is note]
            assert not note.not_run or note == Note(block=note.block, not_run=note.not_run), block


@pytest.fixture
def simulators_ports() -> None:
    """Skip the test if another program has the simulators' usual ports, which the pages use."""
    for port in (5020, 5021, 5030, 5031, 5032):
        with socket.socket() as tried:
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                tried.bind(("127.0.0.1", port))
            except OSError:
                pytest.skip(f"port {port} is in use, which the documentation's commands need")


@pytest.mark.usefixtures("simulators_ports")
@pytest.mark.parametrize("page", RUN)
def test_commands_run_as_written(page: str, domain: int, tmp_path: Path) -> None:
    blocks = blocks_of(page, NOTES)
    if all(block.note.not_run for block in blocks):
        pytest.skip("it has no commands that are run")
    for block, outcome in run_page(blocks, tmp_path, domain):
        assert outcome is None or not outcome.failures, (block, outcome)


def test_what_fails_is_seen(domain: int, tmp_path: Path) -> None:
    blocks = [Block("page.md", 1, commands, note) for commands, (note, _) in FAILURES.items()]
    for block, outcome in run_page(blocks, tmp_path, domain):
        assert outcome is not None
        failure = FAILURES[block.commands][1]
        assert any(each.startswith(failure) for each in outcome.failures), outcome
