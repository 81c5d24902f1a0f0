"""Pictures of the page in each state: ``python tools/watch/pictures.py DIRECTORY``.

Each state is a real graph: a simulation at full speed, a storm that an ensemble of forecasts
predicts, a live site whose drive has a fault, one with a silent roof sensor, one whose pump was
stopped on the page and one where it was released there, a run that ended while the page was open,
and the recording of a run. The page is captured in Chromium, at three widths, light and dark.
``doc/_static/`` has the storm, cut below its charts, and the fault, cut below its second alarm,
both 1400 px wide and light.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import paths  # noqa: F401
from browsers import started_browser
from faults.rig import SiteRig
from graphs import Process, bring_up, free_ports, reserved_domain, wait_for
from places import DATA

WIDTHS, SCHEMES, HEIGHT = (1400, 800, 400), ("light", "dark"), 900
# A storm of 23 mm begins some hours after this time.
_BEFORE_STORM = "2021-07-08T04:00"
_DRAWN = "html[data-drawn=yes]"


@contextmanager
def watcher(domain: int, cwd: Path, *options: str) -> Iterator[str]:
    """Start a watcher and yield its page's address; end it afterwards."""
    process = Process(domain, "watch", "--port", str(free_ports(1)[0]), *options, cwd=cwd)
    try:
        yield wait_for(lambda: _address(process), 60, "an address")
    finally:
        process.process.terminate()
        process.wait(30)


def _address(process: Process) -> str:
    words = process.stdout().split()
    return next((word for word in words if word.startswith("http://")), "")


class Watched(NamedTuple):
    """A graph to be captured.

    Attributes:
        options: of ``watch``.
        clicks: what a person clicks on the page, in order.
        end: ends the graph while the page is open; None if it keeps running.
    """

    options: tuple[str, ...] = ()
    clicks: tuple[str, ...] = ()
    end: Callable[[], Any] | None = None


_NO_CLICKS = Watched()


@contextmanager
def full_speed(domain: int, place: Path) -> Iterator[Watched]:
    """A simulation at full speed, an hour or more after its start."""
    run = Process(
        domain, "bringup", "--controller", "mpc", "--weather",
        str(DATA / "en_climate_hourly_07-2021.csv"), "--evapotranspiration", "fao56",
        "--start", "2021-07-01", "--hours", "700", "--output", "run", cwd=place,
    )
    run.wait_for_ticks(1_000_000)
    yield Watched()
    run.process.terminate()
    run.wait(300)


@contextmanager
def storm(domain: int, place: Path) -> Iterator[Watched]:
    """A storm that an ensemble of forecasts predicts."""
    run = Process(
        domain, "bringup", "--controller", "lookahead", "--horizon", "12", "--hours", "12",
        "--start", _BEFORE_STORM, "--forecast", "ensemble", "--speed", "60", "--initial", "low-low",
        "--output", "run", cwd=place,
    )
    run.wait_for_ticks()
    time.sleep(150)  # about 2.5 h
    yield Watched()
    run.process.terminate()
    run.wait(300)


@contextmanager
def site_with(
    domain: int, place: Path, drive: str, trouble: Callable[[SiteRig], None],
    watched: Watched = _NO_CLICKS, **special: Any,
) -> Iterator[Watched]:
    """A live site whose pump ran, and which has had this trouble for some seconds."""
    with SiteRig(place, domain, drive, **special) as rig:
        rig.until_running(seconds=120, steady_s=10.0)
        trouble(rig)
        yield watched


def fault(domain: int, place: Path) -> Any:
    """A site whose drive reports a fault."""

    def trouble(rig: SiteRig) -> None:
        rig.truth.inject_drive("drive_fault")
        time.sleep(5)
        rig.truth.inject_drive("none")

    # Depth and target of the Neubrandenburg roof, 10 mm below its target.
    return site_with(
        domain, place, "danfoss_fc202", trouble, site_changes={"z_soil": 0.108, "z_veg": 0.039},
        roof_m3=2.0, cistern_m3=40.0,
        controller="lookahead", nodes=("pump", "lookahead", "weather"),
    )


def stale(domain: int, place: Path) -> Any:
    """A site with a silent roof sensor."""

    def trouble(rig: SiteRig) -> None:
        rig.truth.inject_site("roof_silent")
        time.sleep(12)

    return site_with(domain, place, "grundfos_cim500", trouble)


def stopped(domain: int, place: Path) -> Any:
    """A site whose pump a person stopped on the page."""
    watched = Watched(("--allow-release",), ("#stop-button", "#ask-yes"))
    return site_with(domain, place, "danfoss_fc202", lambda _: None, watched)


def released(domain: int, place: Path) -> Any:
    """A site whose pump a person stopped and released on the page."""
    clicks = ("#stop-button", "#ask-yes", "#release-button", "#ask-yes")
    watched = Watched(("--allow-release",), clicks)
    return site_with(domain, place, "danfoss_fc202", lambda _: None, watched)


@contextmanager
def ended(domain: int, place: Path) -> Iterator[Watched]:
    """A run that ends while the page is open."""
    run = Process(
        domain, "bringup", "--controller", "lookahead", "--horizon", "12", "--hours", "12",
        "--speed", "600", "--output", "run", cwd=place,
    )
    run.wait_for_ticks()
    yield Watched(end=lambda: run.wait(300))


@contextmanager
def recording(domain: int, place: Path) -> Iterator[Watched]:
    """The recording of a run."""
    bring_up(domain, place, "--controller", "lookahead", "--horizon", "12", "--hours", "24",
             "--start", "2021-07-08")
    yield Watched(("--bag", "run/bag"))


STATES: dict[str, Callable[[int, Path], Any]] = {
    state.__name__: state
    for state in (full_speed, storm, fault, stale, stopped, released, ended, recording)
}


def click(address: str, selectors: tuple[str, ...]) -> None:
    """Click on the page as slowly as a person who reads what appears."""
    with started_browser() as browser:
        page = browser.new_page()
        page.goto(address)
        for selector in selectors:
            page.locator(selector).click(timeout=60_000)
            time.sleep(5)


def capture(state: str, address: str, directory: Path) -> None:
    """Capture the pictures of a state."""
    with started_browser() as browser:
        for scheme in SCHEMES:
            for width in WIDTHS:
                page = browser.new_page(
                    viewport={"width": width, "height": HEIGHT}, color_scheme=scheme
                )
                page.goto(address)
                page.wait_for_selector(_DRAWN, timeout=120_000, state="attached")
                time.sleep(1)
                page.screenshot(path=directory / f"{state}-{width}-{scheme}.png", full_page=True)
                page.close()


def main() -> None:
    """Capture the states that are asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("directory", type=Path)
    parser.add_argument("--only", nargs="+", choices=list(STATES), default=list(STATES))
    arguments = parser.parse_args()
    arguments.directory.mkdir(parents=True, exist_ok=True)
    for state in arguments.only:
        with ExitStack() as stack:
            domain = stack.enter_context(reserved_domain())
            place = Path(stack.enter_context(tempfile.TemporaryDirectory(
                ignore_cleanup_errors=True)))
            watched = stack.enter_context(STATES[state](domain, place))
            address = stack.enter_context(watcher(domain, place, *watched.options))
            time.sleep(8)
            click(address, watched.clicks)
            if watched.end is not None:
                watched.end()
                time.sleep(8)
            capture(state, address, arguments.directory)
            print(state, flush=True)


if __name__ == "__main__":
    main()
