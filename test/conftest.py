"""What all tests share; the paper's equations and runs are in ``paper.py``."""

from __future__ import annotations

import fcntl
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from graphs import Process, bring_up, own_domain
from hypothesis import settings
from inherited import no_state_of_the_user, pytest_configure
from places import Once
from studies import study

__all__ = ["no_state_of_the_user", "pytest_configure"]

# The same examples on every machine, and no limit on their time.
settings.register_profile("greenroof_ros", deadline=None, derandomize=True)
settings.load_profile("greenroof_ros")

# What takes longest starts first, so that the workers end together: names of tests and files.
LONGEST = (
    "test_fidelity.py", "test_dask", "test_packaging.py", "test_faults.py", "test_live_bringup.py",
    "test_pump_drivers.py", "test_calibrate.py", "test_fit.py", "test_error_model.py",
    "test_report_page.py", "test_report.py",
)


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist looks at the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Say what may run side by side: graphs and studies one by one, the rest by file.

    The tests of a file share what was made for the first of them. Graphs and studies, which take
    longest, share nothing within a process: what several need, ``once`` makes. Graphs mostly wait,
    and files mostly compute: both come evenly mixed, so that the cores are neither idle nor
    crowded.
    """
    alone: dict[str, int] = {}
    files: dict[str, int] = {}
    for item in items:
        graph = "domain" in getattr(item, "fixturenames", ())
        if graph:
            item.add_marker(pytest.mark.graph)
        if "papers" in getattr(item, "fixturenames", ()):
            # What waits for the paper's study waits in one worker.
            item.add_marker(pytest.mark.xdist_group("test_fidelity.py"))
            files.setdefault(item.path.name, len(files))
        elif graph or item.path.parent.name == "study":
            alone[item.nodeid] = len(alone)
        else:
            item.add_marker(pytest.mark.xdist_group(item.path.name))
            files.setdefault(item.path.name, len(files))

    def place(item: pytest.Item) -> tuple[int, float]:
        """Return how far along a test comes: the longest first, then each kind from 0 to 1."""
        for number, name in enumerate(LONGEST):
            if name in (item.name, item.path.name):
                return number, 0.0
        if item.nodeid in alone:
            return len(LONGEST), alone[item.nodeid] / len(alone)
        return len(LONGEST), files[item.path.name] / len(files)

    items.sort(key=place)


@pytest.fixture(scope="session")
def unused_domain() -> Iterator[int]:
    """A ROS domain of this worker's own, for what is refused before it starts a node."""
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


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Once:
    """Fill a directory once for all workers: whoever needs it first does, the others wait."""
    root = tmp_path_factory.getbasetemp()
    if worker_id != "master":  # a worker's own directory is in the session's
        root = root.parent

    def directory_of(name: str, fill: Callable[[Path], object]) -> Path:
        directory = root / name
        with (root / f"{name}.lock").open("w") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX)
            if not directory.exists():
                unfinished = tmp_path_factory.mktemp(name)
                fill(unfinished)
                unfinished.rename(directory)
        return directory

    return directory_of


@pytest.fixture(scope="session")
def recorded(domain: int, once: Once) -> Path:
    """The directory of a good run of a graph: mpc, the paper's site, 360 ticks."""
    return once("recorded", lambda cwd: bring_up(domain, cwd, "--hours", "0.1")) / "run"


@pytest.fixture(scope="session")
def papers(once: Once) -> Path:
    """The paper's study, as the command without options makes it."""

    def fill(directory: Path) -> None:
        result = study(directory)
        assert result.returncode == 0, result.stderr
        assert "7151.78" in result.stdout

    return once("study-of-the-paper", fill) / "studies" / "paper"
