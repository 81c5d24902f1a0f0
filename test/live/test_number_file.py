"""A file of numbers is replaced as a whole."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from refusals import refusal

from greenroof_ros.live.controller import NumberFile


def test_what_is_no_mapping_of_numbers_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "numbers.json"
    file.write_text('{"a": NaN}')
    refusal(NumberFile(file).read, match=r"numbers\.json.*a = 'NaN': must be a finite number")


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
