"""The blocks of commands in README and documentation, and what each needs to run."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from places import CHECKOUT

PAGES = [
    "README.md", "CONTRIBUTING.md",
    *sorted(
        str(path.relative_to(CHECKOUT)) for path in (CHECKOUT / "doc").rglob("*.md")
        if not {"_build", "included"}.intersection(path.parts)
    ),
]
NOTES = Path(__file__).with_name("notes.yaml")
_FENCE = re.compile(r"^( *)```([^\n]*)\n(.*?)^\1```$", re.DOTALL | re.MULTILINE)
_COMMAND = re.compile(
    r"(\$ )?(python|greenroof|make|ros2|pip|colcon|git|ssh|sed|cp|mkdir|export)\s+\S"
)


@dataclass(frozen=True)
class Note:
    """What a block needs to run; the keys of ``notes.yaml``, which explains them."""

    block: str
    not_run: str = ""
    before: str = ""
    after: str = ""
    ready: list[str] = field(default_factory=list)
    then_s: float = 0.0
    says_not: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Block:
    """A block of commands, with its page, its first line there, and its note."""

    page: str
    line: int
    commands: str
    note: Note


def read_notes() -> dict[str, list[Note]]:
    """Return the notes of each page; an unknown key is a TypeError."""
    content: dict[str, list[dict[str, Any]]] = yaml.safe_load(NOTES.read_text(encoding="utf-8"))
    return {page: [Note(**note) for note in notes] for page, notes in content.items()}


def fences(page: str) -> Iterator[tuple[int, str, str]]:
    """Yield the fenced blocks of a page: first line, language, text."""
    text = (CHECKOUT / page).read_text(encoding="utf-8")
    for match in _FENCE.finditer(text):
        indent, language, body = match.groups()
        yield text.count("\n", 0, match.start()) + 1, language, re.sub(
            f"^{indent}", "", body, flags=re.MULTILINE
        )


def blocks_of(page: str, notes: dict[str, list[Note]]) -> list[Block]:
    """Return the blocks of commands of a page, in order."""
    return [
        Block(page, line, body, next(
            (note for note in notes.get(page, []) if body.startswith(note.block)), Note("")
        ))
        for line, language, body in fences(page) if language == "sh"
    ]


def untagged(page: str) -> list[int]:
    """Return the lines of blocks that contain commands but are not marked ``sh``."""
    return [
        line for line, language, body in fences(page)
        if language == "" and any(map(_COMMAND.match, body.splitlines()))
    ]
