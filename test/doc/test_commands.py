"""The command blocks of README and documentation, run as written: a sample of the pages.

``make doc-commands`` runs all of them. ``tools/doc_commands.yaml`` lists what else a page needs,
and what is not run.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
from doc_commands import NOTES, PAGES, fences, run, script_of

# A page without limits in real time, which a busy machine might exceed.
RUN = PAGES if os.environ.get("GREENROOF_ROS_TEST_DOCS") else ["doc/howto/inspect-a-bag.md"]
COMMAND = re.compile(
    r"^(\$ )?(python|greenroof|make|ros2|pip|colcon|git|ssh|sed|cp|mkdir|export)\s+\S", re.MULTILINE
)
# What a page runs from its second line on, and the place and the kind of the failure.
FAILURES = [
    (["true", "python -c 'raise SystemExit(3)'", "true"], "page.md:3: python", "exit code 3"),
    (["python -c '1 / 0' | cat"], "page.md:2: cat", "a traceback"),
    (["sh -c 'exit 4' &", "sleep 1"], "page.md:3: sleep", "exit code 4"),
    (["never_ends ready 20 '' echo ready"], "page.md:2: never_ends", "ended by itself"),
    (["never_ends up 1 loss sh -c 'echo up, loss; sleep 60'"], "page.md:2: ", "printed loss"),
    (["setsid --fork sleep 60"], "page.md:2: ", "left running: sleep 60"),
]


def test_blocks_of_commands_report_it() -> None:
    for page in PAGES:
        for line, language, text in fences(page):
            commands = language in ("", "bash", "console") and COMMAND.search(text)
            assert not commands, f"{page}:{line}"


def test_every_note_is_of_a_block() -> None:
    for page, notes in NOTES.items():
        assert notes.keys() <= {"not_run", "before", "never_ends"}
        blocks = [text for _, language, text in fences(page) if language == "sh"]
        for part in (*notes.get("not_run", ()), *notes.get("before", ())):
            assert sum(part in text for text in blocks) == 1, (page, part)
        for command in notes.get("never_ends", ()):
            lines = script_of(page).values()
            assert any(line.startswith("never_ends ") and command in line for line in lines)


@pytest.mark.parametrize("page", RUN)
def test_commands_run_as_written(page: str, domain: int, tmp_path: Path) -> None:
    script = script_of(page)
    if not script:
        pytest.skip("it has no commands that are run")
    assert run(page, script, tmp_path, domain) == []


@pytest.mark.parametrize(("commands", "place", "kind"), FAILURES)
def test_what_fails_is_seen(
    commands: list[str], place: str, kind: str, domain: int, tmp_path: Path
) -> None:
    (failure,) = run("page.md", dict(enumerate(commands, 2)), tmp_path, domain)
    assert failure.startswith(place) and kind in failure, failure
