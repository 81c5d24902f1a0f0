"""A file of numbers is replaced as a whole, and written again after a failure."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from refusals import refusal

from greenroof_ros.live.number_file import NumberFile


def test_what_is_no_mapping_of_numbers_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "numbers.json"
    file.write_text('{"a": NaN}')
    refusal(NumberFile(file).read, match=r"numbers\.json.*a = 'NaN': must be a finite number")


def test_what_went_wrong_is_tried_again(tmp_path: Path) -> None:
    """The next process reads it."""
    file = tmp_path / "state" / "numbers.json"
    file.parent.write_text("a file where a directory is due")
    numbers = NumberFile(file)
    for values in ({"a": 1.0}, {"a": 1.5, "b": -0.1}):
        numbers.write(values)
        numbers.close()
        assert bool(numbers.problem) == file.parent.is_file()
        file.parent.unlink() if numbers.problem else None
    assert NumberFile(file).read() == {"a": 1.5, "b": -0.1}


def test_the_file_is_on_the_disk_before_it_takes_the_place_of_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise a power cut could leave a name without content."""
    file, contents = tmp_path / "numbers.json", list[tuple[str, str]]()
    file.write_text('{"a": 1.0}')
    monkeypatch.setattr(os, "fsync", lambda number: contents.append(
        (Path(f"/dev/fd/{number}").read_text(), file.read_text())
    ))
    numbers = NumberFile(file)
    numbers.write({"a": 2.0})
    numbers.close()
    assert contents == [('{\n "a": 2.0\n}', '{"a": 1.0}')]
    assert numbers.read() == {"a": 2.0}
