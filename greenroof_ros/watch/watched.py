"""All that is known of a graph, as it is heard or read; it gives the document that people see."""

from __future__ import annotations

import json
import math
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.interface import Topic, read_topics
from greenroof_ros.graph.supervision import ENDED, FINISHED, PUMP
from greenroof_ros.model.look_ahead import MOST_MEMBERS
from greenroof_ros.model.site import Site
from greenroof_ros.watch import tiles, words
from greenroof_ros.watch.account import HOLDS_NS, Account
from greenroof_ros.watch.account import TOPICS as ACCOUNTED
from greenroof_ros.watch.alarms import SILENT_S, Alarms, Status, may_turn
from greenroof_ros.watch.history import History, Unknown, stretch_of
from greenroof_ros.watch.incident_rows import Dated
from greenroof_ros.watch.outlook import AHEAD_S, Forecast, Plan, step_ends

Stamps = NDArray[np.int64]
Values = NDArray[np.float64]
_Dated = TypeVar("_Dated", Forecast, Plan)

# Lines of the charts, each with its topic.
LINES = {
    "roof": "/roof/level",
    "cistern": "/cistern/level",
    "command": "/pump/command",
    "flow": "/pump/flow",
    "rain": "/weather/precipitation",
    "evapotranspiration": "/weather/evapotranspiration",
}
_GAUGE = "/gauge/precipitation"
_NUMBER = "std_msgs/msg/Float64"
_FORECAST, _PUMP_STATE = "/forecast/precipitation", "/pump/state"
_MODES = ("none", "simulated", "loop", "live", "ended")
# How long before a time a level is expected that is compared with the one that came (s).
_LEAD_S = 3600.0
# How often what one plan expects is kept, though its steps are longer (s): the line has no gaps.
_EXPECTED_EVERY_S = 300.0
# No quantity of any site is beyond this, in any unit, although a topic may have no limit.
_LARGEST = 1e9
# A value is stale after so many of its usual intervals, and after so long at least (s). That it
# comes less often than the longest is never usual.
_INTERVALS, _STALE_S, _LONGEST_S = 3, 5.0, 600.0
# No time of a graph is beyond this (ns since 1970): the year 2116.
_LATEST_NS = 2**62
# An account waits for topics that are behind; when nothing came for so long (s), not any more.
_QUIET_S = 2.0
# By so much the system's clock may be set back, or a live site's values be ahead of it (s): less is
# caught up with in a minute.
_SET_BACK_S = 60.0
# A forecast is another one where its rain differs by so much (m), once in so long (s).
_NEW_FORECAST_M, _NEW_FORECAST_S = 2e-3, 3600.0
_MOST_TEXT, _MOST_EVENTS = 500, 50
# Characters of all alarms, and of all events, so that the document stays below 100 kB.
_MOST_ALARMS, _MOST_OF_EVENTS = 55_000, 25_000
# Steps of a forecast or a plan: of the longest look-ahead that there is.
_MOST_STEPS = 1000
_WEEK_H, _MOST_POINTS = 168.0, 2000

# Entries of the account, in order, with their labels.
_ENTRIES = {
    "stress": "Water stress of the plants",
    "evapotranspiration_ratio": "Evapotranspired, of what plants ask for",
    "kept": "Rain kept on the roof",
    "kept_hour": "Rain kept of storms above 20 mm/h",
    "kept_day": "Rain kept of storms above 10 mm in 24 h",
    "deviation": "Mean deviation from the target",
    "rain": "Rain on the roof",
    "pumped": "Pumped onto the roof",
    "drained": "Drained off the roof",
    "evapotranspired": "Evapotranspired",
    "stored": "Change of the water on the roof",
    "unexplained": "Unexplained",
    "inflow": "Rain into the cistern",
    "overflow": "Outflow to the sewer",
    "mains": "Mains water into the cistern, computed from the level",
    "saved": "Potable water saved",
    "energy": "Energy of the pump",
}
# Without rain, or such storms, there is nothing to say of these.
_OF_RAIN = ("kept", "kept_hour", "kept_day")
# Unit, decimals and factor of those that are no volume.
_UNITS = {
    "stress": ("h", 1, 1.0), "deviation": ("mm", 1, 1.0), "energy": ("kWh", 3, 1.0),
    **dict.fromkeys(("evapotranspiration_ratio", *_OF_RAIN), ("%", 0, 100.0)),
}


class _Newest:
    """The newest value of a topic, and how often values come, by the looks at it.

    It may be newer than what the charts have: they come up to it from the recording.
    """

    def __init__(self) -> None:
        self.time_ns = 0
        self.value: float | None = None  # None where it is not plausible
        self.charted_ns = 0  # up to here it is in the charts
        self.stale = False
        self._came = False
        self._heard: float | None = None  # wall time (s)
        self._intervals: deque[float] = deque(maxlen=9)

    def take(self, time_ns: int, value: float | None) -> None:
        self._came = True
        if time_ns >= self.time_ns:
            self.time_ns, self.value = time_ns, value

    def look(self, wall: float) -> None:
        """Note whether something came since the last look, or is overdue."""
        if self._came or self._heard is None:
            if self._heard is not None:
                self._intervals.append(min(wall - self._heard, _LONGEST_S))
            self._came, self._heard = False, wall
        usual = float(np.median(self._intervals)) if self._intervals else 0.0
        self.stale = wall - self._heard > max(_STALE_S, _INTERVALS * usual)

    def silent_for(self, wall: float) -> float:
        """Return how long ago something came (s of wall time)."""
        return 0.0 if self._heard is None else max(0.0, wall - self._heard)


class Watched:
    """What is known of one graph; any thread may call any method.

    Times of the graph are its own: simulated, or the system's. ``wall`` is the steady clock's time
    (s): a system's clock that is set makes no value old or new.
    """

    def __init__(self, namespace: str = "") -> None:
        """Know nothing yet.

        Args:
            namespace: of the graph; empty where it has none.
        """
        self._namespace = namespace
        self._interface = read_topics()
        self._lock = threading.Lock()
        self._site: Site | None = None
        self._site_note = ""
        self._recorded_controller = ""
        self._incidents: Sequence[Dated] = ()
        self._heard_since: float | None = None  # when nodes were first heard (s since 1970)
        self._began = time.time()  # s since 1970
        self._system: float | None = None  # the system's time at the last look (s since 1970)
        # What the graph's nodes said last that it is (s since 1970): of those of a new run, too.
        self._stamp: float | None = None
        self._forget()

    def _forget(self) -> None:
        self._alarms = Alarms(self._namespace)
        self._mode, self._source, self._note = "none", "heard", ""
        self._factor: float | None = None
        self._pump_node: str | None = None
        self._no_stop = ""
        self._forget_values()

    def _forget_values(self) -> None:
        self._newest: dict[str, _Newest] = {}
        self._histories: dict[str, History] = {}
        self._expected = History()
        self._expected_until = -math.inf  # s since 1970
        self._account = None if self._site is None else Account(self._site)
        self._forecast: Forecast | None = None
        self._announced: tuple[float, float] | None = None  # when (s), and rain (m)
        self._plan: Plan | None = None
        self._planned_at = -math.inf  # when it, or that there is none, was said (s since 1970)
        self._previewed: tuple[float, Plan | None] = -math.inf, None  # the same of a newer one
        self._pump_state: tuple[int, str] | None = None
        self._controller: tuple[object, object] | None = None  # name and process
        self._controller_at = -math.inf  # when it was last heard (s since 1970)
        self._unknown_flow = Unknown()
        self._clock_began: float | None = None  # of a simulation, as far as known (s since 1970)
        self._came = False
        self._quiet_since: float | None = None  # wall time (s)

    # --- what comes -----------------------------------------------------------------------------

    def set_site(self, site: Site, note: str = "") -> None:
        """Say by which site levels are judged; with another one the account begins anew.

        Args:
            site: its parameters.
            note: what an operator should know of that; empty where it is plain.
        """
        with self._lock:
            if site != self._site:
                self._account = Account(site)
                self._account.live = self._mode == "live"
            self._site = site
            self._site_note = words.plain(note, _MOST_TEXT)

    def set_present(self, *, mode: str, factor: float | None, source: str, note: str) -> None:
        """Say what is watched now.

        Args:
            mode: ``none`` (nothing was heard yet), ``simulated``, ``loop`` (with the drive of a
                real pump), ``live`` or ``ended``.
            factor: simulated time per wall time; None where there is none.
            source: where the values come from: ``heard``, ``bag`` or ``samples``.
            note: what an operator should know of that; empty where it is plain.

        Raises:
            ValueError: there is no such mode.
        """
        if mode not in _MODES:
            raise ValueError(f"no mode: {mode}")
        with self._lock:
            self._mode, self._source = mode, source
            self._factor = factor if factor is not None and math.isfinite(factor) else None
            self._note = words.plain(note, _MOST_TEXT)
            if self._account is not None:
                self._account.live = mode == "live"

    def set_pump(self, node: str | None, no_stop: str = "") -> None:
        """Say which pump node can be stopped.

        Args:
            node: fully qualified; None where none is present.
            no_stop: why it cannot be stopped from here; empty where it can.
        """
        with self._lock:
            self._pump_node, self._no_stop = node, words.plain(no_stop, _MOST_TEXT)

    def set_recorded_controller(self, name: str) -> None:
        """Say which controller commanded in the run whose recording is shown; empty: unknown."""
        with self._lock:
            self._recorded_controller = words.plain(name, _MOST_TEXT)

    def set_incidents(self, incidents: Sequence[Dated]) -> None:
        """Say which incidents the run had whose recording is shown."""
        with self._lock:
            self._incidents = incidents

    def begin_anew(self) -> None:
        """Forget all of a graph: another one began."""
        with self._lock:
            self._heard_since = None
            self._forget()

    def look(self, wall: float, system: float) -> None:
        """Note what came, and what did not: often, be there a document to show or not.

        Where the clock of a live site is set back, charts and account begin anew: what comes would
        be older than what is there.

        Args:
            wall: now.
            system: the system's time, which is that of a live site (s since 1970).
        """
        with self._lock:
            before, self._system = self._system, system
            if self._mode == "live" and before is not None and system < before - _SET_BACK_S:
                self._forget_values()
                if self._account is not None:
                    self._account.live = True
                back = words.length_of_time(before - system)
                self._alarms.add_event(
                    system, f"The system's clock was set back by {back}: charts and account begin "
                    "anew",
                )
            self._look(wall)

    def add(self, topic: str, times_ns: Stamps, values: Values) -> None:
        """Take values of a topic of single numbers.

        What is not newer than what is there is left out. What is out of the topic's range is shown
        as not plausible, and counts nowhere.

        Args:
            topic: its name in the interface, without a namespace.
            times_ns: since 1970, shape (n,), in their order.
            values: in the topic's unit, shape (n,).
        """
        entry = self._interface.get(topic)
        if entry is None or entry.type != _NUMBER or not len(times_ns):
            return
        # Copies: what is given may be a view of a longer batch. Minus zero becomes zero.
        times = np.array(times_ns, dtype=np.int64)
        numbers = np.asarray(values, dtype=np.float64) + 0.0
        with self._lock:
            newest = self._newest.get(topic) or _Newest()
            possible = np.where(times < _LATEST_NS, times, 0)
            before = np.empty_like(times)
            before[0] = newest.charted_ns
            before[1:] = possible[:-1]
            newer = possible > np.maximum.accumulate(before)
            newer &= possible <= self._latest_ns()
            if not newer.all():
                times, numbers = times[newer], numbers[newer]
            if not len(times):
                return
            self._newest[topic] = newest
            history = self._histories.setdefault(topic, History())
            fine = _plausible(entry, numbers)
            newest.take(int(times[-1]), float(numbers[-1]) if fine[-1] else None)
            newest.charted_ns = int(times[-1])
            self._came = True
            numbers = np.where(fine, numbers, np.nan)
            if topic == LINES["flow"]:
                numbers[self._unknown_flow.at(times / 1e9)] = np.nan
            known = np.isfinite(numbers)
            history.add(times[known], numbers[known])
            if self._account is not None and topic in ACCOUNTED:
                self._account.add(topic, times, numbers)

    def preview(self, topic: str, time_ns: int, value: float) -> None:
        """Take a value whose past is still on its way: it is shown at a glance, and not charted.

        Args:
            topic: its name in the interface, without a namespace.
            time_ns: since 1970; where something newer is there, this is left out.
            value: in the topic's unit.
        """
        entry = self._interface.get(topic)
        if entry is None or entry.type != _NUMBER:
            return
        with self._lock:
            newest = self._newest.get(topic) or _Newest()
            if newest.time_ns < time_ns <= self._latest_ns():
                self._newest[topic] = newest
                fine = _plausible(entry, np.array([value]))[0]
                newest.take(time_ns, value + 0.0 if fine else None)

    def _latest_ns(self) -> float:
        """Return the latest time that a value may have (ns since 1970)."""
        if self._mode == "live" and self._system is not None:
            return (self._system + _SET_BACK_S) * 1e9
        return _LATEST_NS

    def add_forecast(self, topic: str, time_ns: int, values: Values) -> None:
        """Take a forecast; that of rain is shown.

        Args:
            topic: its name in the interface.
            time_ns: when its first step begins, since 1970.
            values: in the topic's unit, shape (steps,), or (members, steps) of an ensemble.
        """
        if topic != _FORECAST or not 0 < time_ns < _LATEST_NS:
            return
        rain = np.atleast_2d(np.asarray(values, dtype=np.float64))
        limits = self._interface[topic]
        with self._lock:
            members, steps = rain.shape if rain.ndim == 2 else (0, 0)
            ends = None
            if self._site is not None and 0 < members <= MOST_MEMBERS and 0 < steps <= _MOST_STEPS:
                ends = step_ends(self._site, steps)
            if ends is None or not np.all((rain >= limits.low) & (rain <= limits.high)):
                self._forecast = None
                return
            at = time_ns / 1e9
            if self._forecast is not None and at <= self._forecast.at:
                return
            self._forecast = Forecast(at, at + ends, rain)
            self._announce(at)

    def _announce(self, now: float) -> None:
        """Note it as an event where the rain that is expected has become another."""
        assert self._forecast is not None
        amount = self._forecast.amount(now)
        if amount is None or amount.reach_s < _NEW_FORECAST_S:
            return
        if self._announced is None:
            self._announced = (now, amount.mean)
            return
        at, before = self._announced
        if abs(amount.mean - before) >= _NEW_FORECAST_M and now - at >= _NEW_FORECAST_S:
            self._announced = (now, amount.mean)
            reach = words.horizon(amount.reach_s)
            self._alarms.add_event(
                now, f"New forecast: {words.rain(amount.mean)} of rain in the next {reach}; "
                f"before, it was {words.rain(before)}",
            )

    def add_plan(self, time_ns: int, rows: Values) -> None:
        """Take what the controller means to pump.

        Args:
            time_ns: when it was planned, since 1970; where a newer one is there, this is left out.
            rows: of each step its end (s from then), mean flow (m3/s), and the level of the roof
                that is expected at its end (m), shape (steps, 3). Empty: nothing has changed. With
                a number that cannot be: there is no plan now.
        """
        at = time_ns / 1e9
        if not np.size(rows) or not 0 < time_ns < _LATEST_NS:
            return
        with self._lock:
            if at <= self._planned_at:
                return  # it was heard already, and is read again
            self._keep_expected(at)
            self._plan, self._planned_at = _plan_of(at, rows), at

    def preview_plan(self, time_ns: int, rows: Values) -> None:
        """Take a plan whose past is still on its way: it is shown, and not kept as expected.

        Args:
            time_ns: when it was planned, since 1970; where a newer one is there, this is left out.
            rows: as of :meth:`add_plan`.
        """
        at = time_ns / 1e9
        if not np.size(rows) or not 0 < time_ns < _LATEST_NS:
            return
        with self._lock:
            if at > self._previewed[0]:
                self._previewed = at, _plan_of(at, rows)

    def _shown_plan(self) -> Plan | None:
        """Return the newest plan; None where it is not known, or there is none."""
        at, plan = self._previewed
        return plan if at > self._planned_at else self._of_now(self._plan)

    def _of_now(self, newest: _Dated | None) -> _Dated | None:
        """Return a forecast or plan; None where newer ones may still be to be read."""
        heard = max((one.time_ns for one in self._newest.values()), default=0)
        charted = self._charted_ns()
        if newest is None or (heard - charted > HOLDS_NS and newest.at * 1e9 <= charted):
            return None
        return newest

    def _keep_expected(self, until: float) -> None:
        """Keep what the plan expects that held until then: it is known that none came before."""
        times, levels = self._not_kept(until)
        if len(times):
            self._expected.add((times * 1e9).astype(np.int64), levels)
            self._expected_until = float(times[-1])

    def _not_kept(self, until: float) -> tuple[Values, Values]:
        """Return what the plan that holds until then expects, of times that nothing is kept of.

        Of each time what the plan of an hour before it expects: times (s since 1970), levels (m).
        """
        plan = self._plan
        if plan is None:
            return np.empty(0), np.empty(0)
        end = min(until + _LEAD_S, float(plan.ends[-1]))
        begin = max(self._expected_until, plan.at + _LEAD_S, end - _WEEK_H * 3600)
        if end <= begin:
            return np.empty(0), np.empty(0)
        often = np.arange(begin + _EXPECTED_EVERY_S, end, _EXPECTED_EVERY_S)
        times = np.unique(np.concatenate([
            plan.ends[(plan.ends > begin) & (plan.ends < end)], often, [end],
        ]))
        return times, np.interp(times, plan.ends, plan.level)

    def add_text(self, topic: str, time_ns: int, text: str) -> None:
        """Take a text: the pump's state, such as ``off: nothing is commanded``."""
        if topic != _PUMP_STATE:
            return
        with self._lock:
            if self._pump_state is None or time_ns > self._pump_state[0]:
                self._pump_state = (time_ns, words.plain(text, _MOST_TEXT))

    def add_statuses(
        self, wall: float, statuses: Sequence[Status], stamp_ns: int | None = None
    ) -> None:
        """Take what nodes said on /diagnostics.

        Args:
            wall: now.
            statuses: of one message.
            stamp_ns: the message's time (ns since 1970), in a simulation that of its clock; None
                where it is not of this graph.
        """
        with self._lock:
            if stamp_ns is not None and 0 < stamp_ns < _LATEST_NS:
                self._stamp = stamp_ns / 1e9
            now = self._now_or(time.time())
            if self._heard_since is None:
                self._heard_since = time.time()
            self._date_anew()
            self._alarms.hear(wall, now, statuses)
            self._note_controller(now)
            self._note_flow(now if self._stamp is None else self._stamp)

    def _note_controller(self, now: float) -> None:
        """Drop the plan of a controller in whose place another one, or another process, is."""
        said = self._alarms.said("controller")
        if said is None:
            return
        controller = said["name"], said["process"]
        if self._controller not in (None, controller):
            self._keep_expected(self._charted_ns() / 1e9)
            # The new one's first plan may have come before its first word.
            if self._plan is not None and self._plan.at <= self._controller_at:
                self._plan = None
            if self._previewed[0] <= self._controller_at:
                self._previewed = self._previewed[0], None
        self._controller, self._controller_at = controller, now

    def _note_flow(self, now: float) -> None:
        """Note since when the pump's flow is not known, which is 0 on its topic then."""
        said = self._alarms.said("pump", self._pump_node)
        if said is not None and "flow" in said:
            self._unknown_flow.say(now, known=said["flow"] is not None)

    def add_event(self, system: float, text: str) -> None:
        """Note an event of now.

        Args:
            system: the system's time, for a graph that has said none yet (s since 1970).
            text: what happened.
        """
        with self._lock:
            self._alarms.add_event(self._now_or(system), text)

    def forgive(self, seconds: float) -> None:
        """Take nobody for silent who was not heard while the watcher stood still, so long (s)."""
        with self._lock:
            self._alarms.forgive(seconds)

    def acknowledge(self, alarm_id: str) -> bool:
        """Note that somebody saw an alarm; False where there is none such."""
        with self._lock:
            return self._alarms.acknowledge(alarm_id)

    # --- what is known --------------------------------------------------------------------------

    def _now(self) -> float | None:
        """Return the graph's time (s since 1970); None before any is known.

        Of a live site it is the system's, otherwise that of the newest value.
        """
        if self._mode == "live" and self._system is not None:
            return self._system
        times = [newest.time_ns for newest in self._newest.values()]
        return max(times) / 1e9 if times else None

    def _date_anew(self) -> None:
        """Date what was noted before the clock of a simulation was known by that clock's begin."""
        first, last = self._began - _SET_BACK_S, time.time() + _SET_BACK_S
        times = (self._clock_began, self._now(), self._stamp)
        known = [at for at in times if at is not None and not first <= at <= last]
        if known:
            self._clock_began = min(known)
            if self._mode in ("simulated", "loop"):
                self._alarms.date_anew(first, last, self._clock_began)

    def _now_or(self, system: float) -> float:
        """Return the time of what happens now (s since 1970).

        Before any value is known it is what the graph's nodes say; before that, the system's.
        """
        known = (self._now(), self._stamp, system)
        return next(at for at in known if at is not None)

    def _charted_ns(self) -> int:
        """Return how far the charts have come (ns since 1970): the newest value of any line."""
        return max((newest.charted_ns for newest in self._newest.values()), default=0)

    @property
    def _utc_offset(self) -> float:
        """Of the times that are shown (h): the site's, UTC where it has none."""
        offset = None if self._site is None else self._site.utc_offset
        return 0.0 if offset is None else offset

    def _value(self, topic: str) -> tiles.Value | None:
        newest = self._newest.get(topic)
        if newest is None:
            return None
        if not newest.stale or self._mode == "ended":
            return tiles.Value(newest.value)
        at, now = newest.time_ns / 1e9, self._now()
        heard = words.time_of_day(at, self._utc_offset, at if now is None else now)
        return tiles.Value(newest.value, stale=True, heard=heard)

    def document(self, wall: float) -> dict[str, Any]:
        """Return all that page and terminal show, as JSON has it: below 100 kB, in plain texts.

        Args:
            wall: now.
        """
        with self._lock:
            return self._document(wall)

    def _document(self, wall: float) -> dict[str, Any]:
        self._look(wall)
        now, offset = self._now(), self._utc_offset

        def say_time(at: float) -> str:
            return words.time_of_day(at, offset, at if now is None else now)

        known = self._alarms.heard or self._mode != "ended"
        incidents = self._incidents_of(now)
        rows = [*(one.row(now or 0.0, say_time) for one in incidents), *self._alarms.rows(say_time)]
        rows.sort(key=lambda row: row["over"] is not None)
        present = [row for row in rows if row["over"] is None]
        pumping, shown = self._tiles(wall, now, present)
        stop = self._stop(wall)
        standing = sum(row["recorded"] for row in present)
        worst = "error" if stop["warning"] or standing else self._alarms.worst()
        serious, warnings, following = self._alarms.counts()
        waiting, too_wet = self._to_come(shown, pumping, now)
        shown["summary"] = tiles.summary(
            shown, tiles.Wrong(
                alarms=serious + standing, warnings=warnings, following=following,
                incidents=len(incidents) - standing, worst=worst, known=known,
            ),
            mode=self._mode, waiting=waiting, too_wet=too_wet,
        )
        advice = self._alarms.advice() if len(present) > standing else tiles.advice(
            shown, mode=self._mode, waiting=waiting
        )
        alarms = _within(rows, _MOST_ALARMS)
        notes = [self._site_note, self._note]
        if not known:
            notes.append(
                "A recording tells when a drive, a sensor or a node was lost; other alarms are not "
                "recorded." if incidents else "A recording does not tell which alarms there were."
            )
        if len(alarms) < len(rows):
            notes.append(f"{len(rows) - len(alarms)} more alarms are not shown.")
        silent = min(
            (newest.silent_for(wall) for newest in self._newest.values()), default=None
        )
        running = self._mode not in ("none", "ended")
        if running and silent and all(newest.stale for newest in self._newest.values()):
            notes.insert(0, f"No values have come for {words.length_of_time(silent)}.")
        return {
            "heading": self._heading(),
            "mode": self._mode,
            "namespace": self._namespace,
            "time": {
                "now": now,
                "utc_offset": offset,
                "factor": self._factor,
                "text": words.UNKNOWN if now is None else words.date_time_and_zone(now, offset),
            },
            "source": self._source,
            "notes": [note for note in notes if note],
            "tiles": shown,
            "advice": advice,
            "alarms": alarms,
            "alarms_known": known,
            "events": _within(self._alarms.events(say_time)[:_MOST_EVENTS], _MOST_OF_EVENTS),
            "account": self._account_of(offset),
            "stop": stop,
        }

    def _look(self, wall: float) -> None:
        """Note what came since the last look."""
        for newest in self._newest.values():
            newest.look(wall)
        self._date_anew()
        self._alarms.look(wall, self._now_or(time.time()))
        if self._came or self._quiet_since is None:
            self._came, self._quiet_since = False, wall
        quiet = wall - self._quiet_since > _QUIET_S
        if self._account is not None and self._mode == "ended" and quiet:
            self._account.end()

    def _heading(self) -> str:
        if self._mode == "none":
            return "Nothing is heard yet"
        if self._mode == "ended":
            return "Ended run"
        if self._mode == "live":
            return "Live site"
        heading = "Simulated run" if self._mode == "simulated" else "Simulated site with a drive"
        if self._factor is None:
            return heading
        factor = words.number(self._factor, 0 if self._factor >= 9.95 else 1).removesuffix(".0")
        if factor == "1":
            return f"{heading}, at real time"
        return f"{heading}, {factor} times real time"

    def _tiles(
        self, wall: float, now: float | None, alarms: Sequence[dict[str, Any]]
    ) -> tuple[tiles.Pumping, dict[str, dict[str, Any]]]:
        values = {name: self._value(topic) for name, topic in LINES.items()}
        pumping = tiles.Pumping(
            said=self._pump_words(),
            gone=self._mode != "ended" and self._pump_gone(wall),
            heard=self._drive_heard(),
            may_turn=(lost := self._pump_lost(now)) or self._may_turn(wall),
            flow_known=not (lost or self._unknown_flow.lasts),
            flow=values["flow"],
            command=values["command"],
            roof=values["roof"],
            cistern=values["cistern"],
            frost=self._value("/weather/frost"),
            kept_off=any(row["id"] == f"{self._pump_name()}: {PUMP}" for row in alarms),
        )
        name = self._alarms.controller()
        if self._mode == "ended":
            name = name or self._recorded_controller or None
        said = self._alarms.said("controller")
        node = None if said is None else said.get("name")
        wrong = [
            row["what"] for row in alarms
            if row["level"] in ("error", "stale") and node
            and (row["id"] == node or row["id"].startswith(f"{node}: "))
        ]
        rain = values["rain"]
        if rain is None:
            rain = self._value(_GAUGE)
        return pumping, {
            "roof": tiles.roof(values["roof"], self._site),
            "cistern": tiles.cistern(values["cistern"], self._site),
            "pump": tiles.pump(pumping, self._site),
            "rain": tiles.rain(
                rain, self._of_now(self._forecast), now, self._utc_offset,
                ended=self._mode == "ended",
            ),
            "controller": tiles.controller(
                name, values["command"], self._shown_plan(), now, self._utc_offset,
                fill_to=self._value("/controller/fill_to"), trust=self._value("/controller/trust"),
                alarm=wrong[0] if wrong else "", ended=self._mode == "ended",
            ),
        }

    def _pump_words(self) -> str | None:
        """Return the pump node's state and why; None where there is no such node."""
        said = self._alarms.said("pump", self._pump_node)
        text = None if said is None else said.get("pump")
        if isinstance(text, str):
            return words.plain(text, _MOST_TEXT)
        return None if self._pump_state is None else self._pump_state[1]

    def _pump_gone(self, wall: float) -> bool:
        """Whether there was a pump node that is not heard now, or has ended."""
        said = self._alarms.said("pump", self._pump_node)
        return said is not None and (
            said["state"] in (FINISHED, ENDED) or wall - said["heard"] > SILENT_S
        )

    def _incidents_of(self, now: float | None) -> list[Dated]:
        """Return the recorded incidents that have begun; none where nodes say how they are.

        On a live site those that were over before the nodes were heard here.
        """
        if self._mode == "live" and self._heard_since is not None:
            return [
                one for one in self._incidents
                if one.ended is not None and one.ended < self._heard_since
            ]
        if self._alarms.heard or self._mode != "ended" or now is None:
            return []
        return [one for one in self._incidents if one.began <= now]

    def _pump_lost(self, now: float | None) -> bool:
        """Whether a recording says that what the pump does is not known now."""
        return any(
            one.of_pump and now is not None and one.stands(now) for one in self._incidents_of(now)
        )

    def _to_come(
        self, shown: dict[str, dict[str, Any]], pumping: tiles.Pumping, now: float | None
    ) -> tuple[str, str]:
        """Return for which rain the controller waits, and how much too wet the roof is to be."""
        if self._mode == "ended":
            return "", ""
        plan, offset = self._shown_plan(), self._utc_offset
        forecast = self._of_now(self._forecast)
        return (
            tiles.waiting(shown["pump"], self._site, pumping, forecast, plan, now, offset),
            tiles.too_wet(shown["roof"], self._site, plan, now, offset),
        )

    def _pump_name(self) -> str:
        """Return the fully qualified name of the pump node; empty where there is none."""
        said = self._alarms.said(PUMP, self._pump_node)
        return "" if said is None else str(said["name"])

    def _drive_heard(self) -> bool:
        """Whether the pump node knows a speed of its drive; so does one that says none."""
        said = self._alarms.said(PUMP, self._pump_node) or {}
        return "speed" not in said or said["speed"] is not None

    def _may_turn(self, wall: float) -> bool:
        """Whether neither that the pump stands is known, nor what it turns at."""
        said = self._alarms.said("pump", self._pump_node)
        if said is None:
            return False
        gone = self._mode != "ended" and self._pump_gone(wall)
        return may_turn(said) or (gone and said.get("stands") is False)

    def _stop(self, wall: float) -> dict[str, Any]:
        """Return whether the pump can be stopped from here, is so, and what is wrong with that.

        It is where an operator stopped it and it stands: the stop alone says that it should.
        ``call`` and ``release`` are what somebody types to stop and release it; empty where that
        would do nothing.
        """
        node = self._pump_node
        said = None if node is None else self._alarms.said("pump", node)
        if said is None or self._no_stop:
            sentence = self._no_stop or "There is no pump node that could be stopped from here."
            return {
                "possible": False, "stopped": False, "node": None, "label": "Stop the pump",
                "sentence": sentence, "warning": self._no_stop, "call": "", "release": "",
            }
        asked = bool(said.get("stop"))
        call = f"ros2 service call {node}/stop std_srvs/srv/SetBool"
        gone = self._pump_gone(wall)
        stands = not gone and said.get("stands") is True
        warning = ""
        if asked and not stands and not gone:
            warning = (
                "Stop was accepted, but the pump still turns, or it is not known whether it "
                "stands. Stop it at its drive's panel if it does not stand within seconds."
            )
        state = (self._pump_words() or "").partition(": ")[0]
        off = state in ("off", "held", "fault") and stands
        stopped = asked and stands
        return {
            "possible": True, "stopped": stopped, "node": node,
            "label": "The pump is held off" if stopped
            else "Keep the pump off" if off else "Stop the pump",
            "sentence": ("It was held off when last heard. " if asked and gone else "")
            + ("The pump is held" if stopped else "Holds the pump")
            + " off until somebody releases it at the pump node.",
            "warning": warning,
            "call": "" if stopped else f'{call} "{{data: true}}"',
            "release": f'{call} "{{data: false}}"' if asked else "",
        }

    def _account_of(self, utc_offset: float) -> dict[str, Any]:
        account = self._account
        totals = {} if account is None else dict(account.totals())
        if "pumped" in totals:
            totals["saved"] = totals["pumped"] - totals.get("mains", 0.0)
        labels = dict(_ENTRIES)
        if self._site is None or self._site.mains_level is None:
            del labels["mains"]
        for key in _OF_RAIN:
            if key not in totals:
                del labels[key]
        since, sentence = "", "not known yet"
        if account is not None and account.since is not None:
            since = f"since {words.date_and_time(account.since / 1e9, utc_offset)}"
            if not account.measured:
                for key in ("drained", "overflow"):
                    labels[key] += ", computed from the level"
            if "unexplained" in totals:
                sentence = f"{words.volume(abs(totals['unexplained']))} not accounted for"
            if account.gap_s:
                sentence += f", with gaps of {words.length_of_time(account.gap_s)}"
        return {
            "since_text": since,
            "sentence": sentence,
            "rows": [
                {
                    "key": key, "label": label, "number": totals.get(key),
                    "value": words.UNKNOWN if key not in totals
                    else words.quantity(totals[key], *_UNITS.get(key, ("m3", 3, 1.0))),
                }
                for key, label in labels.items()
            ],
        }

    def series(self, hours: float, points: int = 400) -> dict[str, Any]:
        """Return what the charts show, from some hours ago to 12 h ahead, in SI units.

        Nothing is known between two rows of a line that are further apart than its entry of
        ``gaps`` (s), and no value holds for longer. Nor from a row of None on to the next.

        Args:
            hours: how far back, at most a week.
            points: of each line, at most, about.
        """
        hours = min(max(hours, 0.1), _WEEK_H) if math.isfinite(hours) else 12.0
        points = min(max(int(points), 10), _MOST_POINTS)
        with self._lock:
            now = self._now()
            site = self._site
            marks: dict[str, Any] = dict.fromkeys(
                ("target", "band", "suction", "low_outlet", "outlet")
            )
            if site is not None:
                marks = {
                    "target": site.z_veg, "band": tiles.band_of(site),
                    "suction": site.suction_level, "low_outlet": site.low_outlet_level,
                    "outlet": site.z_o,
                }
            lines: dict[str, list[list[Any]]] = {
                name: [] for name in ("roof", "roof_expected", *list(LINES)[1:])
            }
            stretch = 0
            if now is not None:
                newest = max((one.time_ns for one in self._newest.values()), default=0)
                last = max(newest, round(now * 1e9))
                first = last - round(hours * 3.6e12)
                stretch = stretch_of(first, last, points)
                for name, topic in LINES.items():
                    if topic in self._histories:
                        lines[name] = self._histories[topic].window(first, last, points)
                lines["roof_expected"] = self._expected.window(first, last, points)
                times, levels = self._not_kept(self._charted_ns() / 1e9)
                present = History()
                present.add((times * 1e9).astype(np.int64), levels)
                lines["roof_expected"] += present.window(first, last, points)
            gaps = {name: _gap(rows, stretch) for name, rows in lines.items()}
            lost = Unknown()
            for one in self._incidents_of(now):
                if one.of_pump:
                    lost.add(one.began, math.inf if one.ended is None else one.ended)
            lines["flow"] = lost.cut_out(self._unknown_flow.cut_out(lines["flow"]))
            forecast, plan = self._of_now(self._forecast), self._shown_plan()
            return {
                "now": now,
                "from": None if now is None else now - hours * 3600,
                "to": None if now is None else now + AHEAD_S,
                "lines": lines,
                "gaps": gaps,
                "forecast": [] if forecast is None else forecast.rows(),
                "plan": [] if plan is None or now is None else plan.rows(now),
                "marks": marks,
                "display": {
                    name: asdict(words.display_of(topic))
                    for name, topic in {**LINES, "forecast": _FORECAST}.items()
                },
            }


def _plan_of(at: float, rows: Values) -> Plan | None:
    """Return the plan of some time (s since 1970); None where one of its numbers cannot be."""
    plan = np.asarray(rows, dtype=np.float64)
    if plan.ndim != 2 or plan.shape[1] != 3 or len(plan) > _MOST_STEPS:
        return None
    ends, flow, level = plan.T
    if not np.all((plan >= 0) & (plan <= _LARGEST)) or ends[0] <= 0 or np.any(np.diff(ends) <= 0):
        return None
    return Plan(at, at + ends, flow, level)


def _plausible(topic: Topic, numbers: Values) -> NDArray[np.bool_]:
    """Return of which values of a topic, in its unit, each is in its range; a NaN is not."""
    low, high = max(topic.low, -_LARGEST), min(topic.high, _LARGEST)
    return (numbers >= low) & (numbers <= high)


def _gap(rows: list[list[float]], stretch_ns: int) -> float:
    """Return beyond which time between its rows a line has a gap (s).

    It is that of the account, or two stretches of which a row tells where those are longer. What
    usually comes less often has a gap where so many of its values are missing that it is stale:
    samples of a run at full speed may be an hour apart.
    """
    gap = max(HOLDS_NS, 2 * stretch_ns) / 1e9
    usual = float(np.median(np.diff([row[0] for row in rows]))) if len(rows) > 1 else 0.0
    return _INTERVALS * usual if usual > gap else gap


def _within(rows: list[dict[str, Any]], most: int) -> list[dict[str, Any]]:
    """Return the first rows that together have at most so many characters as JSON."""
    length = 0
    for place, row in enumerate(rows):
        length += len(json.dumps(row)) + 2
        if length > most:
            return rows[:place]
    return rows
