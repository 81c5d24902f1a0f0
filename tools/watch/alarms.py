"""Every kind of alarm of the fault campaign, on the page in Chromium.

``python tools/watch/alarms.py`` does each case to a real live site as ``make faults`` does, and
holds each fault for longer than the limit once it was said. What a node says is wrong on
``/diagnostics`` must stand on the page within the limit, with the condition's code, and go within
it when it is over. What lasts less than the limit may be missed, but of each kind its own alarm
must be seen: what the campaign wants shown of it, or what follows from it for the node that it is
done to.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import math
import random
import sys
import tempfile
import threading
import time
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import paths  # noqa: F401
from browsers import started_browser
from diagnosed import Diagnosed
from faults.cases import LIVE, Case, Sign, all_cases
from faults.live import Outcome, run_case
from faults.rig import RIGS, BrokenError, Rig, wait
from graphs import Process, free_ports, own_domain

# Within which a change must be on the page (s), where the machine does nothing else.
LIMIT_S = 2.0
# How much longer than that a fault stays once it was said, and each case after its end (s).
_LONGER_S = 1.0
_LOOK_S = 0.1
# A process that was started again is found by each listener in its own time, as Fast DDS announces
# it again and again. So long (s) the page may hear of it before this program does.
_AHEAD_S = 3.0
# What is on the page: of each alarm that stands level and code, by the name of its status; the
# events, the newest first.
_ON_PAGE = """() => [Object.fromEntries(
  [...document.querySelectorAll("[data-alarm]:not([data-over])")].map(
    (alarm) => [alarm.dataset.alarm, `${alarm.dataset.level} ${alarm.dataset.code}`])),
  [...document.querySelectorAll("#events li")].map((event) => event.textContent)]"""
# Kinds that say nothing on this page, by fault and target, and why.
NOT_SAID = {
    ("second pump node", "in another domain"):
        "it reports in its own domain, where this page does not listen",
}


def kinds() -> list[Case]:
    """Return one case for each fault and its conditions that must be shown of a live site.

    Neither those that end the site, and with it all that is said, nor bursts of hostile values: the
    same is said of those that keep coming.
    """
    kinds: dict[tuple[str, tuple[Sign, ...]], Case] = {}
    for case in all_cases():
        if (
            case.way == LIVE and case.expected.signs and case.expected.recovery != "ends"
            and case.fault != "10000 hostile"
        ):
            kinds.setdefault((case.fault, case.expected.signs), case)
    return list(kinds.values())


@dataclass(frozen=True)
class Look:
    """What stood on the page at a time (s).

    Attributes:
        at: when.
        alarms: what is compared of each, by the name of its status.
        events: the newest first.
    """

    at: float
    alarms: dict[str, str]
    events: list[str]

    def restart(self, name: str) -> str:
        """Return the newest event that a node was started again; empty for none."""
        return next((event for event in self.events if f"{name} was started again" in event), "")


class Page:
    """The page in Chromium, looked at ten times a second in a thread of its own.

    Attributes:
        looks: what stood on it.
        problem: why it cannot be looked at any more; empty where it can.
    """

    def __init__(self, url: str) -> None:
        self.looks: list[Look] = []
        self.problem = ""
        self._url, self._ended = url, False
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()
        wait(lambda: self.looks or self.problem, 30, "no browser")

    def _look(self) -> None:
        try:
            with started_browser() as browser:
                page = browser.new_page()
                page.goto(self._url)
                while not self._ended:
                    began = time.monotonic()
                    alarms, events = page.evaluate(_ON_PAGE)
                    self.looks.append(Look(began, alarms, events))
                    time.sleep(_LOOK_S)
        except Exception as error:
            self.problem = f"{type(error).__name__}: {error}"

    def close(self) -> None:
        """Look no more."""
        self._ended = True
        self._thread.join(10)

    def since(self, at: float) -> list[Look]:
        """Return the looks from a time on."""
        return self.looks[bisect_left(self.looks, at, key=lambda look: look.at):]


@dataclass(frozen=True)
class Change:
    """A change that the page followed: its status, what it became, and after how long (s)."""

    name: str
    what: str
    after: float


class Comparison:
    """What was said in a time, and what the page showed of it.

    Attributes:
        said: what was said.
        followed: what it showed within the limit.
        missed: what it did not, in words.
    """

    def __init__(
        self, said: Diagnosed, page: Page, since: float, until: float, limit: float
    ) -> None:
        """Compare.

        Args:
            said: what was said.
            page: what was shown.
            since: what was said from then on counts.
            until: the page was looked at until then.
            limit: within which it must follow (s).
        """
        self.said = said
        self.followed: list[Change] = []
        self.missed: list[str] = []
        self._page, self._limit, self._until = page, limit + _LOOK_S, until
        for name, changes in list(said.said.items()):
            self._compare(name, [*changes, (until, "")], since)
        for at, name in list(said.restarts):
            if at >= since:
                self._compare_restart(name, at)
        for name, what in page.looks[-1].alarms.items():
            changes = said.said.get(name, [(0.0, "")])
            if not changes[-1][1] and changes[-1][0] < until - self._limit:
                self.missed.append(f"{name} {what}: stands, and is not said")

    def _compare(self, name: str, changes: list[tuple[float, str]], since: float) -> None:
        shown, shown_at = "", since
        for number, ((at, what), (then, _)) in enumerate(itertools.pairwise(changes)):
            if at < since:
                shown = what
            elif what != shown:
                again = next((when for when, it in changes[number + 1:-1] if it == what), math.inf)
                looks = self._page.since(max(at - _AHEAD_S, shown_at))
                seen = next((
                    look.at for look in looks
                    if look.at < again and look.alarms.get(name, "") == what
                ), None)
                may_miss = self._limit + (_AHEAD_S if what.startswith("stale not_heard") else 0.0)
                if self._note(name, what, at, seen, must=then - at > may_miss):
                    shown, shown_at = what, seen or at

    def _compare_restart(self, name: str, at: float) -> None:
        looks = self._page.since(at - _AHEAD_S)
        before = looks[0].restart(name) if looks else ""
        seen = next((look.at for look in looks if look.restart(name) != before), None)
        must = self._until - at > self._limit
        self._note(name, "was started again", at, seen, must=must)

    def _note(self, name: str, what: str, at: float, seen: float | None, *, must: bool) -> bool:
        """Note whether a change was followed; return False where it may be missed, and was."""
        if seen is not None and seen - at <= self._limit:
            self.followed.append(Change(name, what, max(0.0, seen - at)))
        elif must:
            when = "never" if seen is None else f"after {seen - at:.1f} s"
            self.missed.append(f"{name} {what or 'is well'}: {when}")
        else:
            return False
        return True


def _until_it_answers(watch: Process) -> None:
    wait(lambda: "http" in watch.stdout() or watch.process.poll() is not None, 30, "no address")


def do(
    cases: list[Case], directory: Path, limit: float
) -> Iterator[tuple[Case, Comparison | None, str]]:
    """Do the cases of one rig, and yield of each what came of it, and what was wrong with it."""
    kind, _, drive = cases[0].rig.partition(":")
    rig: Rig | None = None
    stack = contextlib.ExitStack()
    for number, case in enumerate(cases):
        outcome, comparison = Outcome(), None
        try:
            if rig is None:
                domain = stack.enter_context(own_domain())
                rig = stack.enter_context(RIGS[kind](directory / str(number), domain, drive))
                said = Diagnosed(rig.watcher.node)
                port = free_ports(1)[0]
                watch = Process(domain, "watch", "--port", str(port), cwd=rig.directory)
                stack.callback(watch.process.terminate)
                _until_it_answers(watch)
                page = Page(f"http://127.0.0.1:{port}/")
                stack.callback(page.close)
                rig.until_running()
                wait(lambda p=page, s=said: p.looks[-1].alarms == s.stands, 30, "no page of all")
            began = time.monotonic()
            run_case(rig, case, random.Random(case.id), outcome, limit + _LONGER_S)
            time.sleep(limit + _LONGER_S)
            comparison = Comparison(said, page, began, time.monotonic(), limit)
            if page.problem:
                raise BrokenError(page.problem)
        except Exception as error:  # whatever it is, the next kind gets a new rig
            outcome.fail(f"{type(error).__name__}: {error}")
        last = case.expected.recovery == "stays" or case.fault == "full disk"
        if outcome.wrong or last or number == len(cases) - 1:
            try:
                stack.close()
            except Exception as error:
                outcome.fail(f"at the end of the rig: {type(error).__name__}: {error}")
            rig = None
        yield case, comparison, outcome.wrong


def _verdict(case: Case, comparison: Comparison | None) -> list[str]:
    """Return what the page did not show of a kind, in words; empty where it showed all."""
    if comparison is None:
        return ["not compared"]
    own = any(
        change.name == f"/{case.target}"
        or (change.name.lstrip("/"), change.what.partition(" ")[2]) in case.expected.signs
        for change in comparison.followed if change.what
    )
    if own or (case.fault, case.target) in NOT_SAID:
        return comparison.missed
    return [*comparison.missed, "its alarm was not shown"]


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
    followed: list[Change] = []
    failed: list[str] = []
    with tempfile.TemporaryDirectory() as directory:
        for number, those in enumerate(rigs.values()):
            those.sort(key=lambda case: case.expected.recovery == "stays")
            for case, comparison, wrong in do(
                those, Path(directory) / str(number), arguments.limit
            ):
                missed = _verdict(case, comparison)
                changes = comparison.followed if comparison else []
                followed += changes
                failed += [case.id] if missed else []
                notes = {
                    "the case": wrong, "need not be shown": NOT_SAID.get((case.fault, case.target)),
                }
                print(f"{'FAILED' if missed else 'held':6} {case.id}: {_table(changes)}",
                      *missed, *(f"{what}: {why}" for what, why in notes.items() if why),
                      sep="\n       ", flush=True)
    print(f"{len(cases) - len(failed)} of {len(cases)} kinds held; {_table(followed)}")
    print(*(f"FAILED {case}" for case in failed), sep="\n", end="\n" if failed else "")
    return 1 if failed else 0


def _table(changes: list[Change]) -> str:
    """Return how many changes were followed, and the latest of those shown and gone (s)."""
    text = f"{len(changes)} changes compared"
    for what, times in (
        ("shown", [change.after for change in changes if change.what]),
        ("gone", [change.after for change in changes if not change.what]),
    ):
        text += f", {len(times)} {what}"
        text += f" (latest {max(times):.1f} s)" if times else ""
    return text


if __name__ == "__main__":
    sys.exit(main())
