"""The pictures of the page in the documentation: ``python tools/watch/pictures.py DIRECTORY``.

Each is of a real graph, taken in Chromium: a storm that an ensemble of forecasts sees coming, and a
live site whose drive has a fault.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(CHECKOUT / "test" / "faults"), str(CHECKOUT / "test"), str(CHECKOUT)]

from browsers import started_browser  # noqa: E402
from disturbance import watcher  # noqa: E402
from graphs import Process, own_domain  # noqa: E402
from rig import SiteRig  # noqa: E402

# A storm of 23 mm begins some hours later.
_BEFORE_STORM = "2021-07-08T04:00"


@contextmanager
def storm(domain: int, place: Path) -> Iterator[None]:
    """A storm that an ensemble of forecasts sees coming."""
    run = Process(
        domain, "bringup", "--controller", "lookahead", "--horizon", "12", "--hours", "12",
        "--start", _BEFORE_STORM, "--forecast", "ensemble", "--speed", "60", "--initial", "low-low",
        "--output", "run", cwd=place,
    )
    run.wait_for_ticks()
    time.sleep(150)  # some hours
    yield
    run.process.terminate()
    run.wait(300)


@contextmanager
def fault(domain: int, place: Path) -> Iterator[None]:
    """A live site whose pump ran, and whose drive has reported a fault."""
    with SiteRig(place, domain, "danfoss_fc202") as rig:
        rig.until_running(seconds=120, steady_s=10.0)
        rig.truth.inject_drive("drive_fault")
        time.sleep(5)
        rig.truth.inject_drive("none")
        yield


STATES: tuple[Callable[[int, Path], AbstractContextManager[None]], ...] = (storm, fault)


def main() -> None:
    """Take both."""
    directory = Path(sys.argv[1])
    directory.mkdir(parents=True, exist_ok=True)
    for state in STATES:
        with (
            own_domain() as domain,
            tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as place,
            state(domain, Path(place)),
            watcher(domain, Path(place)) as (_, address),
            started_browser() as browser,
        ):
            time.sleep(8)
            page = browser.new_page(viewport={"width": 1400, "height": 900})
            page.goto(address)
            page.wait_for_selector("html[data-drawn=yes]", timeout=120_000, state="attached")
            time.sleep(1)
            page.screenshot(path=directory / f"watch-{state.__name__}.png", full_page=True)


if __name__ == "__main__":
    main()
