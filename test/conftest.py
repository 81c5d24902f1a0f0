"""Fixtures and hooks for all tests; the paper's equations and runs are in ``paper.py``."""

from __future__ import annotations

import fcntl
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from graphs import Process, bring_up, reserved_domain
from hypothesis import settings
from places import CONFIG, Once
from studies import study

from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.physics import compiled
from greenroof_ros.physics.compiled import can_compile
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.simulation.loop import simulate
from greenroof_ros.site.file import read_site

if TYPE_CHECKING:
    from ros_rig import Observer, Site

# The same examples on every machine, without a time limit.
settings.register_profile("greenroof_ros", deadline=None, derandomize=True)
settings.load_profile("greenroof_ros")

# Names of the longest tests and files: they start first, so the workers end together.
LONGEST = (
    "test_fidelity.py", "test_packaging.py", "test_faults.py", "test_live_bringup.py",
    "test_external_pump_node.py", "test_beside_a_run.py", "test_compiled.py", "test_node_checks.py",
    "test_calibrate.py", "test_fit.py",
    "test_scenario_environments.py", "test_error_model.py", "test_report_page.py", "test_report.py",
)


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile once what all workers then load from the cache."""
    if getattr(session.config.option, "numprocesses", None) and can_compile():
        simulate(make_inputs(find_controller("onoff"), {
            "site": read_site(CONFIG / "site_valve.yaml", {"tau": 60.0}), "outlet": "plan",
            "weather": str(CONFIG / "weather" / "toronto_2021.csv"), "gaps": "fill",
            "start": "2021-07-01T00:00", "hours": 350,
        }).build())


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist looks at the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Set which tests may run in parallel: graphs and studies individually, the rest by file.

    The tests of a file share what was made for the first of them. Graphs and studies take longest
    and share nothing within a process; what several of them need is made by ``once``. Graphs mostly
    wait, and files mostly compute, so both are mixed evenly to keep the cores neither idle nor
    overloaded.
    """
    alone: dict[str, int] = {}
    files: dict[str, int] = {}
    for item in items:
        graph = "domain" in getattr(item, "fixturenames", ())
        if graph:
            item.add_marker(pytest.mark.graph)
        if "papers" in getattr(item, "fixturenames", ()):
            # All tests that need the paper's study run in one worker.
            item.add_marker(pytest.mark.xdist_group("test_fidelity.py"))
            files.setdefault(item.path.name, len(files))
        elif item.path.name != "test_packaging.py" and (  # it shares what pip installs
            graph or item.path.parent.name == "study"
        ):
            alone[item.nodeid] = len(alone)
        else:
            item.add_marker(pytest.mark.xdist_group(item.path.name))
            files.setdefault(item.path.name, len(files))

    def place(item: pytest.Item) -> tuple[int, float]:
        """Return a test's place in the order: the longest first, then each kind from 0 to 1."""
        for number, name in enumerate(LONGEST):
            if name in (item.name, item.path.name):
                return number, 0.0
        if item.nodeid in alone:
            return len(LONGEST), alone[item.nodeid] / len(alone)
        return len(LONGEST), files[item.path.name] / len(files)

    items.sort(key=place)


@pytest.fixture(scope="session")
def unused_domain() -> Iterator[int]:
    """A ROS domain of this worker, for commands that are refused before they start a node."""
    with reserved_domain() as number:
        yield number


@pytest.fixture(scope="session")
def domain(unused_domain: int) -> int:
    """The same domain, for graphs."""
    return unused_domain


@pytest.fixture
def observer(domain: int, tmp_path: Path) -> Iterator[Observer]:
    from ros_rig import Observer

    observer = Observer(domain, tmp_path)
    yield observer
    observer.close()


@pytest.fixture
def site(observer: Observer) -> Site:
    from ros_rig import Site

    return Site(observer)


@pytest.fixture(autouse=True)
def end_leftover_runs() -> Iterator[None]:
    """End runs that a failed test left behind, so that they cannot meet the next test's runs."""
    yield
    Process.end_all()


@pytest.fixture(scope="module", params=[True, False], ids=["compiled", "plain"])
def way(request: pytest.FixtureRequest) -> Iterator[None]:
    """Simulate with numba, whatever the number of ticks, and without it."""
    cached = compiled.can_compile, compiled.compiled
    with pytest.MonkeyPatch.context() as patch:
        if request.param:
            pytest.importorskip("numba")
            patch.setattr(compiled, "MIN_COMPILED", 0)
        else:
            patch.setitem(sys.modules, "numba", None)
        for function in cached:
            function.cache_clear()
        yield
    for function in cached:
        function.cache_clear()


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Once:
    """Fill a directory once for all workers: the first that needs it fills it, the others wait."""
    root = tmp_path_factory.getbasetemp()
    if worker_id != "master":  # a worker's own directory is inside the session's
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
    """The directory of a successful graph run: mpc, the paper's site, 360 ticks."""
    return once("recorded", lambda cwd: bring_up(
        domain, cwd, "--controller", "mpc", "--hours", "0.1"
    )) / "run"


@pytest.fixture(scope="session")
def papers(once: Once) -> Path:
    """The paper's study, as the command makes it without options."""

    def fill(directory: Path) -> None:
        result = study(directory)
        assert result.returncode == 0, result.stderr
        assert "7152" in result.stdout  # the total of mpc from low-low, 7151.78 m3

    return once("study-of-the-paper", fill) / "studies" / "paper"
