"""The Python code of the documentation's pages runs as written, in a clone."""

from __future__ import annotations

from pathlib import Path

import pytest
from doc_commands import fences
from places import CHECKOUT


@pytest.mark.parametrize("page", [
    "doc/tutorials/python.md", "doc/reference/scenarios.md",
])
def test_code_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if "tutorials" in page:
        pytest.importorskip("gymnasium", reason="gymnasium is not installed")
    (tmp_path / "config").symlink_to(CHECKOUT / "config")
    monkeypatch.chdir(tmp_path)
    blocks = [text for _, language, text in fences(page) if language == "python"]
    assert len(blocks) >= 2
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, page, "exec"), names)
    if "tutorials" in page:
        assert (tmp_path / "onoff" / "summary.json").is_file()
        for picture in ("onoff.png", "compared.png"):
            assert (tmp_path / picture).stat().st_size > 10_000
