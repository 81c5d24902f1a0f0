"""Files that users edit, and how their YAML is read."""

from __future__ import annotations

import gzip
import itertools
import math
import os
from pathlib import Path

import pytest
from commands import run_command
from places import refusal

from greenroof_ros.base.files import read_text, read_yaml
from greenroof_ros.site.file import read_site


def test_plain_values(tmp_path: Path) -> None:
    """Numbers are those of YAML 1.2, and truth values also those of YAML 1.1."""
    file = tmp_path / "a.yaml"
    file.write_text(
        f"a: [016, 3:0, .5, 5.78e5, 1e-5, -.inf, {2**63}, -1{'0' * 400}]\n"
        "b: [on, No, TRUE, ~, null, 2021-07-07, 1_000, 0x1F, '5', \"no\"]\n"
    )
    assert read_yaml(file) == {
        "a": [16, "3:0", 0.5, 578000.0, 1e-5, -math.inf, 2**63, -math.inf],
        "b": [True, False, True, None, None, "2021-07-07", "1_000", 0x1F, "5", "no"],
    }


def test_packed_files(tmp_path: Path) -> None:
    """A file named .gz is unpacked; one that is cut off, or is not packed, is refused."""
    file, packed = tmp_path / "a.csv.gz", gzip.compress(b"time,rain [mm]\n")
    file.write_bytes(packed)
    assert read_text(file) == "time,rain [mm]\n"
    for damaged in (packed[:-6], b"time,rain [mm]\n"):
        file.write_bytes(damaged)
        assert refusal(read_text, file).startswith(f"{file}: cannot be read: ")


def test_lines_and_anchors(tmp_path: Path) -> None:
    """Each key has its line; an alias has its anchor's value; a byte order mark is dropped."""
    file = tmp_path / "a.yaml"
    file.write_text("\ufeff# c\na: &x [1, {b: 2}]\nc:\n  d: *x\n")
    content = read_yaml(file)
    assert content == {"a": [1, {"b": 2}], "c": {"d": [1, {"b": 2}]}}
    assert (content.lines, content["c"].lines) == ({"a": 2, "c": 3}, {"d": 4})


def nested(levels: int) -> str:
    """Return a value with lists of ten in lists of ten, by anchors and aliases."""
    rows, value = list[str](), "x"
    for level in range(levels):
        rows.append(f"&m{level} [{', '.join([value] * 10)}]")
        value = f"*m{level}"
    return f"[{', '.join(rows)}]"


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("a: 1\nb: 2\na: 3\n", ", line 3"), ("a: 1\n---\nb: 2\n", ", line 2"),
        ("a:\n\tb: 1\n", ", line 2"), ("a: 1\nb: \0\n", ", line 2"),
        ("a: 1\n# m\udcb2\n", ", line 2"), ("a: " + "[" * 2000 + "]" * 2000, ", line 1"),
        ("a: " + "[" * 400_000, ", line 1"), ("a: &x [*x]\n", ""),
        ("a: !!int 5\n", ", line 1"), ("a: {!!str b: 1}\n", ", line 1"),
        ("a: {? [b] : 1}\n", ", line 1"), (f"a: {nested(8)}\n", ", line 1"),
        (f"a: {'x' * 1_000_000}\n", ""),
    ],
    ids=itertools.count(),
)
def test_what_is_refused(tmp_path: Path, text: str, place: str) -> None:
    """The error has the file, and the line if there is one."""
    file = tmp_path / "a.yaml"
    file.write_text(text, encoding="utf-8", errors="surrogateescape")
    assert refusal(read_yaml, file).startswith(f"{file}{place}: is ")


@pytest.mark.parametrize("value", [
    nested(4), "x" * 900_000, "7" * 5000, "-" + "9" * 400, f"[{'12345, ' * 100_000}]",
    f"{{{', '.join(f'k{number}: 1' for number in range(5000))}}}",
], ids=itertools.count())
def test_no_value_fills_a_message(tmp_path: Path, value: str) -> None:
    """A site file is refused in a few lines, whatever stands in the place of a value."""
    file = tmp_path / "site.yaml"
    for key in ("tau", "extends"):
        file.write_text(f"{key}: {value}\n")
        assert len(refusal(read_site, file)) < 5000


CONTROLS = '"\\x1b[31m\\r\u202e\u2066"'


@pytest.mark.parametrize("text", [f"{CONTROLS}: 1", "\33"])
def test_no_control_character_reaches_the_terminal(tmp_path: Path, text: str) -> None:
    """They would colour, overwrite or reorder what is printed. Names of files and options count."""
    file = tmp_path / "\33[31m\r\u202e\u2066.yaml"
    file.write_text(f"{text}\n")
    for words in (["--site", str(file)], [f"--{file.name}"], ["--controller", file.name]):
        done = run_command(
            "__main__", "simulate", "--hours", "1", *words, cwd=tmp_path, env=dict(os.environ)
        )
        assert done.returncode == 2
        assert r"\x1b[31m\r\u202e\u2066" in done.stderr
        assert all(sign == "\n" or sign.isprintable() for sign in done.stderr)
