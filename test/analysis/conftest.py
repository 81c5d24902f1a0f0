"""A Dask cluster for the tests of what runs on one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from dask_cluster import Dask


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[Dask]:
    """Start a Dask scheduler without workers, which is ended with all that it got."""
    started = Dask(tmp_path)
    yield started
    for process in (*started.workers, started.scheduler):
        process.kill()
        process.wait()
