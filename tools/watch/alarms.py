"""Every kind of alarm of the fault campaign, on the page in Chromium.

``pytest tools/watch/alarms.py -s`` does each case to a real live site as ``make faults`` does, and
keeps each fault for longer than the limit after it was reported. All that a node reports as wrong
on ``/diagnostics`` must appear on the page within the limit, with the condition's code, and
disappear within it afterwards. A change that lasts less than the limit may be missed, but each kind
must show its own alarm: one that the campaign expects, or one of the node with the fault.
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

# Time within which a change must be on the page (s), if the machine does nothing else.
LIMIT_S = 2.0
# Time that a fault stays beyond this limit after it was reported, and each case after its end (s).
_LONGER_S = 1.0
_POLL_S = 0.1
# Each listener discovers a restarted process in its own time, as Fast DDS announces it repeatedly.
# The page may hear of it this much earlier than this program (s).
_AHEAD_S = 3.0
# Reads the page: level and code of each standing alarm, by the name of its status; the events,
# newest first; and the notes, which list what is missing while a site starts.
_ON_PAGE = """() => [Object.fromEntries(
  [...document.querySelectorAll("[data-alarm]:not([data-over])")].map(
    (alarm) => [alarm.dataset.alarm, `${alarm.dataset.level} ${alarm.dataset.code}`])),
  [...document.querySelectorAll("#events li")].map((event) => event.textContent),
  [...document.querySelectorAll("#notes li")].map((note) => note.textContent)]"""
# Kinds that this page does not show, by fault and target, with the reason.
NOT_REPORTED = {
    ("second pump node", "in another domain"):
        "it reports in its own domain, where this page does not listen",
}


def kinds() -> list[Case]:
    """Return one case for each fault and set of conditions that a live site must show.

    Cases that end the site, and so all reports, are left out, and so are bursts of hostile values,
    which show the same as repeated ones.
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
class Snapshot:
    """What stood on the page at a time (s).

    Attributes:
        at: when.
        alarms: level and code of each alarm, by the name of its status.
        events: newest first.
        notes: below the summary.
    """

    at: float
    alarms: dict[str, str]
    events: list[str]
    notes: list[str]

    def shows(self, name: str, what: str) -> bool:
        """Return whether a status is as reported, or listed as missing at the start."""
        listed = what and any(note.startswith(f"{name}: ") for note in self.notes)
        return bool(listed) or self.alarms.get(name, "") == what

    def shows_all(self, reported: dict[str, str]) -> bool:
        """Return whether it shows everything that was reported, and nothing else."""
        return self.alarms.keys() <= reported.keys() and all(
            self.shows(name, what) for name, what in reported.items()
        )

    def restart(self, name: str) -> str:
        """Return the newest event that reports a node's restart; empty if there is none."""
        return next((event for event in self.events if f"{name} was started again" in event), "")


class Page:
    """The page in Chromium, read ten times a second in a thread of its own.

    Attributes:
        looks: what stood on it.
        problem: why it cannot be read any more; empty if it can.
    """

    def __init__(self, url: str) -> None:
        self.snapshots: list[Snapshot] = []
        self.problem = ""
        self._url, self._ended = url, False
        self._thread = threading.Thread(target=self._poll, daemon=True)
        self._thread.start()
        wait(lambda: self.snapshots or self.problem, 30, "no browser")

    def _poll(self) -> None:
        try:
            with started_browser() as browser:
                page = browser.new_page()
                page.goto(self._url)
                while not self._ended:
                    began = time.monotonic()
                    self.snapshots.append(Snapshot(began, *page.evaluate(_ON_PAGE)))
                    time.sleep(_POLL_S)
        except Exception as error:
            self.problem = f"{type(error).__name__}: {error}"

    def close(self) -> None:
        """Stop reading."""
        self._ended = True
        self._thread.join(10)

    def since(self, at: float) -> list[Snapshot]:
        """Return the looks from a time on."""
        return self.snapshots[bisect_left(self.snapshots, at, key=lambda snapshot: snapshot.at):]


@dataclass(frozen=True)
class Change:
    """A change that the page showed: its status, its new value, and the delay (s)."""

    name: str
    what: str
    after: float


class Comparison:
    """What nodes reported in a period, and what the page showed of it.

    Attributes:
        followed: the changes that it showed within the limit.
        missed: the changes that it did not show in time, in words.
    """

    def __init__(
        self, diagnosed: Diagnosed, page: Page, since: float, until: float, limit: float
    ) -> None:
        """Compare.

        Args:
            diagnosed: what was reported.
            page: what was shown.
            since: start of the reports to compare.
            until: time until which the page was read.
            limit: time within which the page must follow (s).
        """
        self.followed: list[Change] = []
        self.missed: list[str] = []
        self._page, self._limit, self._until = page, limit + _POLL_S, until
        for name, changes in list(diagnosed.changes.items()):
            self._compare(name, [*changes, (until, "")], since)
        for at, name in list(diagnosed.restarts):
            if at >= since:
                self._compare_restart(name, at)
        for name, what in page.snapshots[-1].alarms.items():
            changes = diagnosed.changes.get(name, [(0.0, "")])
            if not changes[-1][1] and changes[-1][0] < until - self._limit:
                self.missed.append(f"{name} {what}: is shown, but was not reported")

    def _compare(self, name: str, changes: list[tuple[float, str]], since: float) -> None:
        shown, shown_at = "", since
        for number, ((at, what), (then, _)) in enumerate(itertools.pairwise(changes)):
            if at < since:
                shown = what
            elif what != shown:
                again = next((when for when, it in changes[number + 1:-1] if it == what), math.inf)
                snapshots = self._page.since(max(at - _AHEAD_S, shown_at))
                first_shown = next((
                    snapshot.at for snapshot in snapshots
                    if snapshot.at < again and snapshot.shows(name, what)
                ), None)
                may_miss = self._limit + (_AHEAD_S if what.startswith("stale not_heard") else 0.0)
                if self._note(name, what, at, first_shown, must=then - at > may_miss):
                    shown, shown_at = what, first_shown or at

    def _compare_restart(self, name: str, at: float) -> None:
        snapshots = self._page.since(at - _AHEAD_S)
        before = snapshots[0].restart(name) if snapshots else ""
        restarts = (snapshot.at for snapshot in snapshots if snapshot.restart(name) != before)
        first_shown = next(restarts, None)
        must = self._until - at > self._limit
        self._note(name, "was started again", at, first_shown, must=must)

    def _note(
        self, name: str, what: str, at: float, first_shown: float | None, *, must: bool
    ) -> bool:
        """Note whether a change was shown; return False if it may be missed, and was."""
        if first_shown is not None and first_shown - at <= self._limit:
            self.followed.append(Change(name, what, max(0.0, first_shown - at)))
        elif must:
            when = "never" if first_shown is None else f"after {first_shown - at:.1f} s"
            self.missed.append(f"{name} {what or 'is well'}: {when}")
        else:
            return False
        return True


class Pages:
    """The page of each rig, and all comparisons."""

    def __init__(self, rigs: Rigs) -> None:
        self.rigs = rigs
        self.followed: list[Change] = []
        self._rig: Rig | None = None

    def compare(self, rig: Rig, case: Case, outcome: Outcome) -> Comparison:
        """Do a case to a rig, and compare its page with what was reported."""
        if rig is not self._rig:
            self._open(rig)
        began = time.monotonic()
        run_case(rig, case, random.Random(case.id), outcome, LIMIT_S + _LONGER_S)
        time.sleep(LIMIT_S + _LONGER_S)
        if self._page.problem:
            raise BrokenError(self._page.problem)
        comparison = Comparison(self._diagnosed, self._page, began, time.monotonic(), LIMIT_S)
        self.followed += comparison.followed
        return comparison

    def _open(self, rig: Rig) -> None:
        diagnosed = self._diagnosed = Diagnosed(rig.watcher.node)
        port = free_ports(1)[0]
        watch = Process(rig.domain, "watch", "--port", str(port), cwd=rig.directory)
        self.rigs.stack.callback(watch.process.terminate)
        wait(watch.stdout, 30, "no address")
        page = self._page = Page(f"http://127.0.0.1:{port}/")
        self.rigs.stack.callback(page.close)
        wait(lambda: page.snapshots[-1].shows_all(diagnosed.problems), 30, "no page of all")
        rig.until_running()  # last, because some rigs' pumps may run for only 20 s
        self._rig = rig


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pages]:
    """Read the page of each rig; at the end print how late it was."""
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
    """The page shows each change in time, and the alarm of the case's kind."""
    comparisons: list[Comparison] = []
    outcome = Outcome()
    pages.rigs.do(
        case, outcome, lambda rig: comparisons.append(pages.compare(rig, case, outcome))
    )
    assert comparisons, outcome.wrong
    (comparison,) = comparisons
    print(f"{case.id}: {_table(comparison.followed)}; the case: {outcome.wrong or 'as it should'}")
    assert comparison.missed == []
    # If another status of the node has the code, the page may show only that status.
    codes = {code for _, code in case.expected.signs}
    own = any(
        change.name == f"/{case.target}" or change.what.partition(" ")[2] in codes
        for change in comparison.followed if change.what
    )
    assert own or (case.fault, case.target) in NOT_REPORTED


def _table(changes: list[Change]) -> str:
    """Return the number of compared changes, and the largest delay of those shown and gone (s)."""
    text = f"{len(changes)} changes compared"
    for what, times in (
        ("shown", [change.after for change in changes if change.what]),
        ("gone", [change.after for change in changes if not change.what]),
    ):
        text += f", {len(times)} {what}"
        text += f" (latest {max(times):.1f} s)" if times else ""
    return text
