"""The pictures of the page in ``doc/_static/``: ``python tools/watch/pictures.py``.

Each is of a real graph: the storm of the tutorial "First run", and the live site of the tutorials
with a fault of its drive. The page is captured in Chromium, in the width of a column of text, and
in the width of a phone.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import paths
from brokers import mosquitto
from browsers import started_browser
from doc_commands import fences
from graphs import Process, bag_file, free_ports, reserved_domain, wait_for
from ros_rig import write_forecast
from simulators import Simulator

HEIGHT = 900
# Name of the file after "watch-", width (px), and the part of the page below which the picture is
# cut.
PICTURES = {
    "storm": (
        ("storm", 820, "#charts"), ("storm-narrow", 400, "#charts > :first-child"),
        ("top", 820, "#charts > :first-child"), ("top-narrow", 400, "#values > :nth-child(3)"),
    ),
    "fault": (
        ("fault", 980, "#stop"), ("fault-narrow", 400, "#values > :nth-child(3)"),
    ),
}
# More pixels are sharp on a phone, too.
_SCALE, _MARGIN = 1.5, 4
# Overheating of the motor, by the drive's model of it: bit 8 of the Danfoss drive's alarms.
_OVERHEATING = 1 << 8
# Wait at 60 times real time, the highest speed at which the page shows values. With the start of
# the page, it is then about 09:50 in the run.
_STORM_S = 390.0
# Time for which the pump runs before the fault (s).
_BEFORE_FAULT_S = 60.0
# Time until the page has what was last reported (s).
_SHOWN_S = 8.0


@contextmanager
def storm(domain: int, place: Path) -> Iterator[Callable[[], object]]:
    """The storm of the tutorial "First run" at about 09:50."""
    run = Process(
        domain, "bringup", "--controller", "lookahead", "--start", "2021-07-08T03:00",
        "--cistern", "57.7", "--roof", "1", "--speed", "60", "--output", "run", cwd=place,
    )
    bag = bag_file(run.cwd / "run")
    wait_for(lambda: bag.exists() and bag.stat().st_size > 30_000, 120, "a growing bag")
    yield lambda: time.sleep(_STORM_S)
    run.process.terminate()
    run.wait(300)


@contextmanager
def fault(domain: int, place: Path) -> Iterator[Callable[[], object]]:
    """The live site of the tutorials, with a drive on Modbus whose motor overheats.

    The roof is a few millimetres below its target.
    """
    with mosquitto(place) as broker, ExitStack() as stack:
        (new_site, *_) = (body for _, language, body in fences(
            "doc/tutorials/your-site-and-weather.md") if language == "sh")
        _, *words = shlex.split(new_site.replace("\\\n", ""))
        subprocess.run([sys.executable, "-m", "greenroof_ros", *words], cwd=place, check=True)
        site = place / "my_site.yaml"
        site.write_text(site.read_text().replace("\ntau: 60.0", "\ntau: 1.0"))
        (sensors,) = (body for *_, body in fences("doc/tutorials/a-live-site.md")
                      if body.startswith("# my_sensors.yaml"))
        (place / "my_sensors.yaml").write_text(sensors.replace("mqtt://127.0.0.1", broker.address))
        files = ("--site", str(site), "--sensors", str(place / "my_sensors.yaml"))
        write_forecast(place / "forecast.csv", hours=48)
        drive = stack.enter_context(Simulator("drive_simulator", "--drive", "danfoss_fc202",
                                              "--port", str(*free_ports(1))))
        stack.enter_context(Simulator(
            "site_simulator", *files, "--drive-at", drive.workbench, "--rain", "0",
            "--cistern", "5.6", "--roof", "1.38",
        ))
        live = Process(
            domain, "live.live_site", "--controller", "lookahead", *files,
            "--forecast", "forecast.csv", "--drive", "danfoss_fc202", "--drive-at", drive.address,
            "--state", "state", cwd=place,
        )

        def overheat() -> None:
            time.sleep(_BEFORE_FAULT_S)
            drive.inject("drive_fault", _OVERHEATING)

        live.until_printed("running:")
        yield overheat
        live.process.terminate()
        live.wait(60)


def capture(state: str, address: str) -> None:
    """Capture the pictures of a state."""
    with started_browser() as browser:
        for name, width, last in PICTURES[state]:
            page = browser.new_page(
                viewport={"width": width, "height": HEIGHT}, device_scale_factor=_SCALE
            )
            page.goto(address)
            page.wait_for_selector("html[data-drawn=yes]", timeout=120_000, state="attached")
            time.sleep(1)
            box = page.locator(last).bounding_box()
            page.screenshot(
                path=paths.CHECKOUT / "doc" / "_static" / f"watch-{name}.png",
                full_page=True,
                clip={"x": 0, "y": 0, "width": width,
                      "height": box["y"] + box["height"] + _MARGIN},
            )


def make(state: Callable[[int, Path], AbstractContextManager[Callable[[], object]]]) -> None:
    """Make the pictures of a state."""
    with (
        reserved_domain() as domain, tempfile.TemporaryDirectory() as scratch,
        state(domain, Path(scratch)) as happen,
    ):
        (port,) = free_ports(1)
        watcher = Process(domain, "watch", "--port", str(port), cwd=Path(scratch))
        wait_for(lambda: f":{port}" in watcher.stdout(), 60, "an address")
        time.sleep(_SHOWN_S)
        happen()
        time.sleep(_SHOWN_S)
        capture(state.__name__, f"http://127.0.0.1:{port}")
        watcher.process.terminate()
        watcher.wait(30)


if __name__ == "__main__":
    for each in (storm, fault):
        make(each)
