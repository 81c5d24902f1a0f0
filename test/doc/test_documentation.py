"""README and documentation: they build; their links, tables and commands are valid."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from doc_commands.blocks import fences
from places import CHECKOUT

sys.path.append(str(CHECKOUT / "doc"))

import generate

DOC = CHECKOUT / "doc"
PAGES = [
    CHECKOUT / "README.md", CHECKOUT / "CONTRIBUTING.md",
    *sorted(path for path in DOC.rglob("*.md") if "_build" not in path.parts),
]
# The largest number of words on a page of each kind, by the caption in the table of contents.
WORDS = {"How-to guides": 700, "Explanation": 1800}


def name(path: Path) -> str:
    return str(path.relative_to(CHECKOUT))


def listed(page: Path, caption: str = "") -> Iterator[Path]:
    """Yield the pages of a page's table of contents, under a caption if given, and of theirs."""
    for tree in re.findall(r"^```{toctree}\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE):
        if caption in tree:
            for entry in re.findall(r"^\w.*", tree, re.MULTILINE):
                below = page.parent / f"{entry}.md"
                yield from (below, *listed(below))


@pytest.mark.parametrize(("page", "lines"), [("README.md", 90), ("CONTRIBUTING.md", 60)])
def test_first_pages_are_short(page: str, lines: int) -> None:
    assert len((CHECKOUT / page).read_text().splitlines()) <= lines


@pytest.mark.parametrize("kind", WORDS)
def test_a_page_has_few_words(kind: str) -> None:
    """A generated table is for looking up, and does not count."""
    words = {
        page: len(generate._BLOCK.sub("", page.read_text()).split())
        for page in listed(DOC / "overview.md", kind)
    }
    assert len(words) >= 10
    assert {name(page): number for page, number in words.items() if number > WORDS[kind]} == {}


def test_documentation_has_few_words() -> None:
    """README and ``doc/``, without the reference, which is generated or holds tables."""
    read = [
        page for page in PAGES
        if page.parent.name not in ("reference", "modules") and page.name != "CONTRIBUTING.md"
    ]
    assert sum(len(page.read_text().split()) for page in read) <= 30_000


def test_phrases_that_nobody_says_are_refused(tmp_path: Path) -> None:
    """``make lint`` names each, also at a line's end or in capitals, but not parts of words."""
    phrases = (
        "held against", "of which", "That of", "those of", "is told", "So long",  # codespell:ignore
        "but for", "astray", "owed", "Anew",  # codespell:ignore
    )
    (tmp_path / "page.md").write_text("\n".join(f"- It is {each}" for each in phrases))
    (tmp_path / "fine.md").write_text("a share that often shows; followed renewal of whichever\n")
    done = subprocess.run(
        [sys.executable, "-m", "codespell_lib", str(tmp_path)], cwd=CHECKOUT, text=True,
        capture_output=True,
    )
    named = re.findall(r"(\w+)\.md:\d+: (.+) ==>", done.stdout)
    assert named == [("page", each) for each in phrases], done.stderr


def test_phrases_that_nobody_says_are_not_split_between_lines() -> None:
    """``make lint`` reads line by line. Comments, docstrings and messages in code count, too."""
    phrases = re.findall("^(.* .*)->", (CHECKOUT / "phrases.txt").read_text(), re.MULTILINE)
    split = "|".join(phrase.replace(" ", r'[ "]*\n[\s"#]*') for phrase in phrases)
    for path in [*PAGES, *(CHECKOUT / "greenroof_ros").rglob("*.py")]:
        assert not re.findall(rf"\b({split})\b", path.read_text(), re.IGNORECASE), path


@pytest.mark.parametrize(
    "page", [page for page in PAGES if "<!-- table: " in page.read_text()], ids=name
)
def test_tables_are_the_packages(page: Path) -> None:
    """'make docs' would write nothing else."""
    text = page.read_text()
    assert generate.renew(text) == text


def test_commands_are_introduced_as_their_help_does() -> None:
    """With paragraphs; and an option's value is not shown as the name of a function."""
    text = (DOC / "reference" / "commands.md").read_text()
    assert (
        "shows the roof.\n\nWith `--drive` and `--drive-at` there is hardware in the loop: a "
        "drive instead of the simulated pump"
    ) in text
    assert not re.search(r"^\| `--[^|]*\| (parse|\\?_\w+) \|", text, re.MULTILINE)


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
            assert module.startswith("greenroof_ros.nodes."), "a command is greenroof's"
            section = nodes.split(f"### {module.rpartition('.')[2]}\n")[1].split("### ")[0]
            assert ros == "--ros-args"
            for each in given[1::2]:
                assert f"| `{each.partition(':=')[0]}` |" in section
            continue
        command = words[1] if words[1] in generate.COMMANDS else " ".join(words[1:3])
        assert command in generate.COMMANDS, words
        arguments = words[1 + len(command.split()) :]
        if name(page) != "doc/reference/commands.md":  # there it is the usage, without values
            generate.parser_of(command, arguments).parse_args(arguments)


def test_pictures_differ_in_their_colours_only() -> None:
    light, dark = (
        re.sub(r":root \{.*?\}", "", (DOC / "_static" / f"roof-and-graph-{kind}.svg").read_text())
        for kind in ("light", "dark")
    )
    assert light == dark


def test_drawings_show_the_interface() -> None:
    """'make docs' would draw nothing else."""
    assert len(generate.WAYS) == 3
    for name, way in generate.WAYS.items():
        drawn = (DOC / "_static" / f"{name}.svg").read_text()
        assert drawn == generate.drawing(way), name


def test_picture_shows_the_topics() -> None:
    from greenroof_ros.common.interface import read_topics

    picture = (DOC / "_static" / "roof-and-graph-light.svg").read_text()
    shown = set(re.findall(r"/[a-z]+(?:/[a-z]+)?(?=[<, \u00a0])", picture))
    shown = {each for each in shown if each.count("/") == 2 or each == "/clock"}
    assert len(shown) == 11
    assert shown <= set(read_topics())
