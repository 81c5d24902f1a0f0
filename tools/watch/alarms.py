"""Every kind of alarm of the fault campaign, on the page in Chromium.

``pytest tools/watch/alarms.py -s`` does each case to a real live site as ``make faults`` does, and
holds each fault for longer than the limit once it was said. What a node says is wrong on
``/diagnostics`` must stand on the page within the limit, with the condition's code, and go within
it when it is over. What lasts less than the limit may be missed, but of each kind its own alarm
must be seen: what the campaign wants shown of it, or what follows from it for the node that it is
done to.
"""

from __future__ import annotations

import itertools
import math
import random
import threading
import time
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from browsers import started_browser
from faults.cases import LIVE, Case, Sign, all_cases
from faults.live import Outcome, Rigs, run_case
from faults.rig import BrokenError, Rig, wait
from graphs import Process, environment, free_ports
from watch.diagnosed import Diagnosed

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
    return sorted(kinds.values(), key=lambda case: (case.rig, case.expected.recovery == "stays"))


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


class Pages:
    """The page of each rig, and all that was compared."""

    def __init__(self, rigs: Rigs) -> None:
        self.rigs = rigs
        self.followed: list[Change] = []
        self._rig: Rig | None = None

    def compare(self, rig: Rig, case: Case, outcome: Outcome) -> Comparison:
        """Do a case to a rig, and compare its page with what was said."""
        if rig is not self._rig:
            self._open(rig)
        began = time.monotonic()
        run_case(rig, case, random.Random(case.id), outcome, LIMIT_S + _LONGER_S)
        time.sleep(LIMIT_S + _LONGER_S)
        if self._page.problem:
            raise BrokenError(self._page.problem)
        comparison = Comparison(self._said, self._page, began, time.monotonic(), LIMIT_S)
        self.followed += comparison.followed
        return comparison

    def _open(self, rig: Rig) -> None:
        said = self._said = Diagnosed(rig.watcher.node)
        port = free_ports(1)[0]
        watch = Process(rig.domain, "watch", "--port", str(port), cwd=rig.directory)
        self.rigs.stack.callback(watch.process.terminate)
        wait(watch.stdout, 30, "no address")
        page = self._page = Page(f"http://127.0.0.1:{port}/")
        self.rigs.stack.callback(page.close)
        wait(lambda: page.looks[-1].alarms == said.stands, 30, "no page of all")
        rig.until_running()  # last: some rigs' pumps may run for 20 s only
        self._rig = rig


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pages]:
    """Look at the page of each rig, and print at the end how late it was."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment(0).items():
            patch.setenv(name, value)
        pages = Pages(Rigs(tmp_path_factory.mktemp("alarms")))
        yield pages
        pages.rigs.end()
    print(_table(pages.followed))


@pytest.mark.parametrize("case", [
    pytest.param(case, id=case.id, marks=pytest.mark.xdist_group(case.rig)) for case in kinds()
])
def test_alarm(pages: Pages, case: Case) -> None:
    """The page follows each change in time, and shows the alarm of the kind."""
    comparisons: list[Comparison] = []
    outcome = Outcome()
    pages.rigs.do(
        case, outcome, lambda rig: comparisons.append(pages.compare(rig, case, outcome))
    )
    assert comparisons, outcome.wrong
    (comparison,) = comparisons
    print(f"{case.id}: {_table(comparison.followed)}; the case: {outcome.wrong or 'as it should'}")
    assert comparison.missed == []
    # Where another status of the node has the code, the page may show that one alone.
    codes = {code for _, code in case.expected.signs}
    own = any(
        change.name == f"/{case.target}" or change.what.partition(" ")[2] in codes
        for change in comparison.followed if change.what
    )
    assert own or (case.fault, case.target) in NOT_SAID


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
