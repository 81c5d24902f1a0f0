"""Every kind of alarm of the fault campaign, on the page in Chromium.

``python test/watch/alarms.py`` does each case to a real live site as ``make faults`` does. A node
of the campaign hears ``/diagnostics``; what a part of a node says is wrong for longer than the
limit must stand on the page within it, in the node's words, and go within it when it is over.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import re
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent / "faults"), str(HERE.parent), str(HERE.parent.parent)]

from cases import LIVE, NODES, Case, all_cases  # noqa: E402
from graphs import Process, free_ports, own_domain  # noqa: E402
from live import Outcome, run_case  # noqa: E402
from playwright.sync_api import sync_playwright  # noqa: E402
from rig import RIGS, BrokenError, Rig, SkippedError, wait  # noqa: E402

# Within which a change of a status must be on the page (s), where the machine does nothing else.
LIMIT_S = 2.0
_LOOK_S = 0.1
# So much of a sentence is compared, without its numbers: the page cuts it at 500 characters.
_COMPARED = 300
# What is on the page: of each alarm that stands the words, by the name of its status; the events.
_ON_PAGE = """() => [Object.fromEntries(
  [...document.querySelectorAll("[data-alarm]:not([data-over])")].map(
    (one) => [one.dataset.alarm, one.textContent])),
  document.getElementById("events").textContent]"""


def kinds() -> list[Case]:
    """Return one case for each fault and alarm that must be said of a live site.

    A pump node in another domain is heard of there alone.
    """
    found: dict[tuple[str, str], Case] = {}
    for case in all_cases():
        if (
            case.way == LIVE and case.expected.alarm and case.expected.recovery != "ends"
            and case.fault != "10000 hostile" and case.target != "in another domain"
        ):
            found.setdefault((case.fault, case.expected.alarm), case)
    return list(found.values())


class Page:
    """The page in Chromium, looked at ten times a second in a thread of its own.

    Attributes:
        seen: what stood on it, as (time, words by the name of the status, events).
        problem: why it cannot be looked at any more; empty where it can.
    """

    def __init__(self, url: str) -> None:
        self.seen: list[tuple[float, dict[str, str], str]] = []
        self.problem = ""
        self._url, self._ended = url, False
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()
        wait(lambda: self.seen or self.problem, 30, "no browser")

    def _look(self) -> None:
        chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))))
        try:
            with sync_playwright() as playwright:
                browser = playwright.chromium.launch(
                    executable_path=chromium, args=["--no-sandbox"])
                page = browser.new_page()
                page.goto(self._url)
                while not self._ended:
                    began = time.monotonic()
                    alarms, events = page.evaluate(_ON_PAGE)
                    words = {name: _without_numbers(text) for name, text in alarms.items()}
                    self.seen.append((began, words, events))
                    time.sleep(_LOOK_S)
                browser.close()
        except Exception as error:
            self.problem = f"{type(error).__name__}: {error}"

    def close(self) -> None:
        self._ended = True
        self._thread.join(10)

    def first(self, name: str, since: float, text: str | None) -> float | None:
        """Return when a status first stood on the page with these words; None: was not there."""
        for at, alarms, _ in list(self.seen):
            if at < since:
                continue
            if (text is None and name not in alarms) or (
                text is not None and text in alarms.get(name, "")
            ):
                return at
        return None

    def names(self, node: str, since: float) -> float | None:
        """Return when an alarm or event named a node first; None: was not there."""
        before = next((events for at, _, events in reversed(self.seen) if at < since), "")
        for at, alarms, events in list(self.seen):
            told = events.count(f"/{node} ") > before.count(f"/{node} ")
            if at >= since and (told or any(name.startswith(f"/{node}") for name in alarms)):
                return at
        return None


def _without_numbers(text: str) -> str:
    """Return a sentence whose numbers may go on while it stands."""
    return re.sub(r"[0-9.]+", "", text)


def changes(
    rig: Rig, since: float, until: float, limit: float
) -> Iterator[tuple[float, str, str | None]]:
    """Yield what the page must follow: time, status and its words, None for well.

    What lasts less than the limit need not be seen.
    """
    by_name: dict[str, list[tuple[float, str | None]]] = {}
    for at, who, text in list(rig.watcher.said):
        if ": " not in who:
            continue
        words = None
        if not text.startswith("OK "):
            words = _without_numbers(text.partition(" ")[2])[:_COMPARED]
        said = by_name.setdefault(who, [])
        if not said or said[-1][1] != words:
            said.append((at, words))
    for name, said in by_name.items():
        stood: str | None = None  # before: well
        for (at, words), (then, _) in zip(said, [*said[1:], (until, "")], strict=True):
            if then - at > limit and words != stood:
                stood = words
                if at >= since:
                    yield at, name, words


def check(
    rig: Rig, page: Page, case: Case, since: float, tally: list[tuple[float, bool]], limit: float
) -> list[str]:
    """Return what the page did not follow since a time, and count what it did."""
    until = time.monotonic()
    time.sleep(limit)
    wrong = []
    if case.fault in ("kill", "stop long") and case.target in NODES:
        seen = page.names(case.target, since)
        if seen is None:
            wrong.append(f"{case.target} was not named")
    for at, name, words in changes(rig, since, until, limit):
        seen = page.first(name, at, words)
        if seen is None or seen - at > limit + _LOOK_S:
            late = "never" if seen is None else f"after {seen - at:.1f} s"
            wrong.append(f"{name} {'is well' if words is None else repr(words)}: {late}")
        else:
            tally.append((seen - at, words is not None))
    return wrong


def _until_it_answers(watch: Process) -> None:
    wait(lambda: "http" in watch.stdout() or watch.process.poll() is not None, 30, "no address")


def do(
    cases: list[Case], directory: Path, tally: list[tuple[float, bool]], limit: float
) -> Iterator[str]:
    """Do the cases of one rig, and yield a line of each."""
    kind, _, drive = cases[0].rig.partition(":")
    rig: Rig | None = None
    page: Page | None = None
    stack = contextlib.ExitStack()
    for number, case in enumerate(cases):
        outcome, wrong, count = Outcome(), [], len(tally)
        try:
            if rig is None or page is None:
                domain = stack.enter_context(own_domain())
                rig = stack.enter_context(RIGS[kind](directory / str(number), domain, drive))
                port = free_ports(1)[0]
                watch = Process(domain, "watch", "--port", str(port), cwd=rig.directory)
                stack.callback(watch.process.terminate)
                _until_it_answers(watch)
                page = Page(f"http://127.0.0.1:{port}/")
                stack.callback(page.close)
            began = time.monotonic()
            run_case(rig, case, random.Random(case.id), outcome)
            wrong = check(rig, page, case, began, tally, limit)
            if page.problem:
                raise BrokenError(page.problem)
        except (BrokenError, SkippedError) as error:
            outcome.fail(str(error))
        if outcome.wrong or case.expected.recovery == "stays" or case.fault == "full disk":
            stack.close()
            rig = page = None
        said = "; ".join(filter(None, (*wrong, outcome.wrong and f"the case: {outcome.wrong}")))
        yield f"{'FAILED' if wrong else 'held':6} {case.id}: {len(tally) - count} changes {said}"
    stack.close()


def main() -> int:
    """Do one case of each kind, or those asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", default=[], metavar="ID", help="beginnings of ids")
    parser.add_argument(
        "--limit", type=float, default=LIMIT_S,
        help="within which a change must be on the page (default: %(default)s s)",
    )
    parser.add_argument("--list", action="store_true", help="list the cases, and do none")
    arguments = parser.parse_args()
    cases = [c for c in kinds() if not arguments.only or c.id.startswith(tuple(arguments.only))]
    if arguments.list:
        print(*(case.id for case in cases), sep="\n")
        return 0
    rigs: dict[str, list[Case]] = {}
    for case in cases:
        rigs.setdefault(case.rig, []).append(case)
    tally: list[tuple[float, bool]] = []
    failed = done = 0
    with tempfile.TemporaryDirectory() as directory:
        for number, those in enumerate(rigs.values()):
            those.sort(key=lambda case: case.expected.recovery == "stays")
            for line in do(those, Path(directory) / str(number), tally, arguments.limit):
                print(line, flush=True)
                failed += line.startswith("FAILED")
                done += 1
    for shown, what in ((True, "shown"), (False, "gone")):
        times = sorted(took for took, is_alarm in tally if is_alarm is shown)
        if times:
            print(f"{len(times)} {what}, the latest after {times[-1]:.1f} s")
    print(f"{done - failed} of {done} kinds held")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
