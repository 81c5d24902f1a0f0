"""Pictures of the page in each state: ``python tools/watch/pictures.py DIRECTORY``.

Each state is a real graph: the storm of the tutorial "First run", the live site of the tutorials
whose drive has a fault, a live site with a silent roof sensor, one whose pump was stopped on the
page and one where it was released there, and a run that ended while the page was open. The page is
captured in Chromium, at three widths, light and dark.

``python tools/watch/pictures.py --doc`` makes the pictures of ``doc/_static/``: each in the width
of a column of text, and in the width of a phone.
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
from brokers import mosquitto
from browsers import started_browser
from doc_commands.blocks import fences
from faults.rig import Simulator, SiteRig
from graphs import Process, free_ports, reserved_domain, wait_for
from places import CHECKOUT, DATA
from simulators import Workbench

from greenroof_ros.live.devices.modbus_line import parse_address

WIDTHS, SCHEMES, HEIGHT = (1400, 800, 400), ("light", "dark"), 900
# The pictures of the documentation: end of the file's name, width (px), and the part of the page
# below which it is cut. More pixels are sharp on a phone, too.
IN_DOC = {
    "storm": (("", 820, "#charts"), ("-narrow", 400, "#charts > :first-child")),
    "fault": (("", 980, "#alarms > :nth-child(2)"), ("-narrow", 400, "#tiles > :nth-child(3)")),
}
_SCALE, _MARGIN = 1.5, 4
# Overheating of the motor, by the drive's model of it: bit 8 of the Danfoss drive's alarms.
_OVERHEATING = 1 << 8
# The fault comes when the roof has reached this level; the target is 39 mm (m).
_ROOF_AT_FAULT = 0.0345
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
        event: what happens while the page is open; None for nothing.
    """

    options: tuple[str, ...] = ()
    clicks: tuple[str, ...] = ()
    event: Callable[[], Any] | None = None


_NO_CLICKS = Watched()


@contextmanager
def storm(domain: int, place: Path) -> Iterator[Watched]:
    """The storm of the tutorial "First run" at 09:00, after six minutes."""
    run = Process(
        domain, "bringup", "--controller", "lookahead", "--start", "2021-07-08T03:00",
        "--cistern", "57.7", "--roof", "1", "--speed", "60", "--output", "run", cwd=place,
    )
    run.wait_for_ticks()
    yield Watched(event=lambda: time.sleep(360))
    run.process.terminate()
    run.wait(300)


@contextmanager
def site_with(
    domain: int, place: Path, drive: str, trouble: Callable[[SiteRig], None],
    watched: Watched = _NO_CLICKS,
) -> Iterator[Watched]:
    """A live site whose pump ran, and which has had this trouble for some seconds."""
    with SiteRig(place, domain, drive) as rig:
        rig.until_running(seconds=120, steady_s=10.0)
        trouble(rig)
        yield watched


@contextmanager
def fault(domain: int, place: Path) -> Iterator[Watched]:
    """The live site of the tutorials, with a drive on Modbus whose motor overheats.

    The roof fills from 15 mm, and the fault comes a few millimetres below its target.
    """
    with mosquitto(place) as broker, ExitStack() as simulators:

        def start(module: str, *options: str) -> Simulator:
            simulator = Simulator(domain, place, module, *options)
            simulators.callback(simulator.end)
            return simulator

        for page, file in (("your-site-and-weather", "my_site.yaml"),
                           ("a-live-site", "my_sensors.yaml")):
            (text,) = (body for *_, body in fences(f"doc/tutorials/{page}.md")
                       if body.startswith(f"# {file}"))
            (place / file).write_text(text.replace("mqtt://127.0.0.1", broker.address))
        site, sensors = ("--site", "my_site.yaml"), ("--sensors", "my_sensors.yaml")
        # Two days without rain follow.
        weather = ("--weather", str(DATA / "en_climate_hourly_07-2021.csv"),
                   "--start", "2021-07-18T08:00")
        service, modbus, bench = free_ports(3)
        start("forecast_simulator", *site, *weather, "--port", str(service))
        drive = start("drive_simulator", "--drive", "danfoss_fc202", "--port", str(modbus),
                      "--workbench", str(bench))
        start("site_simulator", *site, *sensors, *weather, "--workbench", "0",
              "--drive-at", f"tcp://127.0.0.1:{bench}",
              "--cistern", "5.6", "--roof", "0.6", "--output", "levels.csv")
        live = Process(
            domain, "bringup.live", "--controller", "lookahead", *site, *sensors,
            "--forecast", "open-meteo", "--fetch-url", f"http://127.0.0.1:{service}/v1/forecast",
            "--drive", "danfoss_fc202", "--drive-at", drive.place, "--state", "state", cwd=place,
        )

        def overheat() -> None:
            wait_for(lambda: roof_level(place / "levels.csv") > _ROOF_AT_FAULT, 300, "the level")
            workbench = Workbench(parse_address(f"tcp://127.0.0.1:{bench}"))
            workbench.inject("drive_fault", _OVERHEATING)
            workbench.close()
            time.sleep(5)

        live.until_printed("running:")
        yield Watched(event=overheat)
        live.process.terminate()
        live.wait(60)


def roof_level(levels: Path) -> float:
    """Return the last level of the roof in a file of the site's simulator (m)."""
    last = levels.read_text().splitlines()[-1].split(",")[2]
    return float(last) if last[0].isdigit() else 0.0


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
        domain, "bringup", "--controller", "lookahead", "--horizon", "12", "--hours", "2",
        "--speed", "60", "--output", "run", cwd=place,
    )
    run.wait_for_ticks()
    yield Watched(event=lambda: run.wait(300))


STATES: dict[str, Callable[[int, Path], Any]] = {
    state.__name__: state
    for state in (storm, fault, stale, stopped, released, ended)
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
                page = _opened(browser, address, width, color_scheme=scheme)
                page.screenshot(path=directory / f"{state}-{width}-{scheme}.png", full_page=True)
                page.close()


def capture_for_doc(state: str, address: str, directory: Path) -> None:
    """Capture the pictures of a state for the documentation."""
    with started_browser() as browser:
        for suffix, width, last in IN_DOC[state]:
            page = _opened(browser, address, width, device_scale_factor=_SCALE)
            box = page.locator(last).bounding_box()
            page.screenshot(
                path=directory / f"watch-{state}{suffix}.png", full_page=True,
                clip={"x": 0, "y": 0, "width": width,
                      "height": box["y"] + box["height"] + _MARGIN},
            )
            page.close()


def _opened(browser: Any, address: str, width: int, **options: Any) -> Any:
    """Open the page in a window of a width (px), and wait until it is drawn."""
    page = browser.new_page(viewport={"width": width, "height": HEIGHT}, **options)
    page.goto(address)
    page.wait_for_selector(_DRAWN, timeout=120_000, state="attached")
    time.sleep(1)
    return page


def main() -> None:
    """Capture the states that are asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("directory", type=Path, nargs="?", default=CHECKOUT / "doc" / "_static")
    parser.add_argument("--only", nargs="+", choices=list(STATES))
    parser.add_argument("--doc", action="store_true", help="make the documentation's pictures")
    arguments = parser.parse_args()
    arguments.directory.mkdir(parents=True, exist_ok=True)
    for state in arguments.only or (IN_DOC if arguments.doc else STATES):
        with ExitStack() as stack:
            domain = stack.enter_context(reserved_domain())
            place = Path(stack.enter_context(tempfile.TemporaryDirectory(
                ignore_cleanup_errors=True)))
            watched = stack.enter_context(STATES[state](domain, place))
            address = stack.enter_context(watcher(domain, place, *watched.options))
            time.sleep(8)
            click(address, watched.clicks)
            if watched.event is not None:
                watched.event()
                time.sleep(8)
            (capture_for_doc if arguments.doc else capture)(state, address, arguments.directory)
            print(state, flush=True)


if __name__ == "__main__":
    main()
