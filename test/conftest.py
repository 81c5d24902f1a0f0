"""What all tests share; the paper's equations and runs are in ``paper.py``."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from graphs import Process, own_domain
from hypothesis import settings

# The same examples on every machine, and no limit on their time.
settings.register_profile("greenroof_ros", deadline=None, derandomize=True)
settings.load_profile("greenroof_ros")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that start nodes: they need both cores, and the domain, for themselves."""
    for item in items:
        if "domain" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.graph)


@pytest.fixture(scope="session")
def unused_domain() -> Iterator[int]:
    """A ROS domain of this session's own, for what is refused before it starts a node."""
    with own_domain() as number:
        yield number


@pytest.fixture(scope="session")
def domain(unused_domain: int) -> int:
    """The same, for graphs."""
    return unused_domain


@pytest.fixture(autouse=True)
def nothing_left() -> Iterator[None]:
    """A run that a failed test leaves behind must not meet the next test's."""
    yield
    Process.end_all()
