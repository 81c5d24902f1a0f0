"""What all tests share; the paper's equations and runs are in ``paper.py``."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from graph import own_domain
from hypothesis import settings

# The same examples on every machine, and no limit on their time.
settings.register_profile("greenroof_ros", deadline=None, derandomize=True)
settings.load_profile("greenroof_ros")


@pytest.fixture(scope="session")
def domain() -> Iterator[int]:
    """A ROS domain of this session's own."""
    with own_domain() as number:
        yield number
