"""README and documentation: they build; their links, tables and commands are valid."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from doc_commands import PAGES as NAMES
from doc_commands import fences
from places import CHECKOUT

sys.path.append(str(CHECKOUT / "doc"))

import generate

from greenroof_ros.live.devices.sensor_file import read_sensors

DOC = CHECKOUT / "doc"
PAGES = [CHECKOUT / page for page in NAMES]


def name(path: Path) -> str:
    return str(path.relative_to(CHECKOUT))


@pytest.mark.parametrize(
    "page", [page for page in PAGES if "<!-- end of " in page.read_text()], ids=name
)
def test_tables_and_excerpts_are_the_packages(page: Path) -> None:
    """'make docs' would write nothing else."""
    text = page.read_text()
    assert generate.renew(text) == text


def anchors(path: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and MyST make them."""
    anchors = set()
    for heading in re.findall(r"^#+ (.+)$", path.read_text(), re.MULTILINE):
        text = re.sub(r"[`*]|\[|\]\(.*?\)", "", heading).lower()
        anchors.add(re.sub(r"[^\w\- ]", "", text).replace(" ", "-"))
    return anchors


def links(text: str) -> Iterator[str]:
    """Yield what a page links to or shows; code is left out."""
    text = re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"`[^`\n]*`", "", text)
    yield from re.findall(r"\]\(\s*([^)\s]+)\s*\)", text)
    yield from re.findall(r"(?:src|srcset|href)=\"([^\"]+)\"", text)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_somewhere(page: Path) -> None:
    for link in links(page.read_text()):
        if link.startswith(("https://", "http://")):
            continue
        target, _, anchor = link.partition("#")
        path = (page.parent / target).resolve() if target else page
        assert path.exists(), link
        if anchor:
            assert anchor in anchors(path), link


def commands(page: Path) -> Iterator[list[str]]:
    """Yield the words of each command of this package in a page's blocks."""
    for _, language, block in fences(name(page)):
        if language not in ("sh", "text"):
            continue
        for line in block.replace("\\\n", " ").splitlines():
            command = line.strip().partition(" > ")[0]
            ours = command.startswith(("greenroof ", "python -m greenroof_ros."))
            if ours and "$" not in command:
                yield shlex.split(command.removesuffix("&"), comments=True)


@pytest.mark.parametrize("page", [page for page in PAGES if any(commands(page))], ids=name)
def test_commands_can_be_given(page: Path) -> None:
    """The options of each command that is shown exist, and accept the values."""
    nodes = (DOC / "reference" / "nodes.md").read_text()
    for words in commands(page):
        if words[0] == "python":
            module, ros, *given = words[2:]
            own = ("greenroof_ros.nodes.", "greenroof_ros.live.")
            assert module.startswith(own), "a command is greenroof's"
            assert ros == "--ros-args"
            for each in given[1::2]:
                assert f"`{each.partition(':=')[0]}`" in nodes
            continue
        command = words[1] if words[1] in generate.COMMANDS else " ".join(words[1:3])
        assert command in generate.COMMANDS, words
        arguments = words[1 + len(command.split()) :]
        parser = generate.parser_of(command, arguments)
        if command == "simulators live":  # it passes other options on
            arguments = parser.parse_known_args(arguments)[1]
            parser = generate.parser_of("live", arguments)
        parser.parse_args(arguments)


def test_drawings_show_the_interface() -> None:
    """'make docs' would draw nothing else."""
    assert len(generate.WAYS) == 2
    for name, way in generate.WAYS.items():
        drawn = (DOC / "_static" / f"{name}.svg").read_text()
        assert drawn == generate.drawing(way), name


def test_picture_shows_the_topics() -> None:
    from greenroof_ros.interface.topics import read_topics

    picture = (DOC / "_static" / "graph.svg").read_text()
    shown = set(re.findall(r"/[a-z]+(?:/[a-z]+)?(?=[<, \u00a0])", picture))
    shown = {each for each in shown if each.count("/") == 2 or each == "/clock"}
    assert len(shown) == 11
    assert shown <= set(read_topics())


def test_from_nothing_has_a_file_of_sensors_that_a_site_reads(tmp_path: Path) -> None:
    page = DOC / "tutorials" / "a-live-site.md"
    (text,) = (body for *_, body in fences(name(page)) if body.startswith("# my_sensors.yaml"))
    (tmp_path / "my_sensors.yaml").write_text(text)
    assert read_sensors(tmp_path / "my_sensors.yaml").by_section.keys() == {
        "cistern", "roof", "thermometer"
    }
