"""The pump node's reports on its parts: pump, inputs, drive, delivery and dose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from greenroof_ros.interface.conditions import Diagnosis, read_interlocks
from greenroof_ros.live.devices.exchange import DriveExchange, DriveSnapshot
from greenroof_ros.live.live_diagnostics import ERROR, OK, WARN, LiveDiagnostics
from greenroof_ros.live.live_input import LiveInput, bad_inputs, join_diagnoses
from greenroof_ros.live.pumping.dose import DONE, Dose, Doses
from greenroof_ros.live.pumping.pump_control import Decision, drive_fault
from greenroof_ros.live.pumping.pump_inputs import INPUTS


class PumpReports:
    """Diagnoses of the pump node's parts; messages that contain numbers are not logged."""

    def __init__(
        self, reports: LiveDiagnostics, inputs: Mapping[str, LiveInput], exchange: DriveExchange
    ) -> None:
        """Report nothing yet.

        Args:
            reports: reports of the node.
            inputs: inputs of the node, by their names in
                :mod:`greenroof_ros.live.pumping.pump_inputs`.
            exchange: the communication with the drive.
        """
        self._reports, self._inputs, self._exchange = reports, inputs, exchange
        reports.hardware = str(exchange.endpoint)

    def update(
        self, now: float, decision: Decision, doses: Doses, second_pump: Diagnosis | None
    ) -> None:
        """Report on every part.

        Args:
            now: current time, from `boot_time` (s).
            decision: the last decision.
            doses: the requests for doses.
            second_pump: diagnosis of a second pump node; None if there is only one pump node.
        """
        diagnose = self._reports.diagnose
        first = next(iter(decision.interlocks.values()), None)
        wrong = first is not None and first.code != "quiet_hours"  # these are as intended
        level, shown = ERROR if decision.state == "fault" else WARN if wrong else OK, first
        if decision.state != "fault" and not decision.at_rest:
            # What the pump does matters more than why it should be off.
            if decision.reported_speed is None:
                level, shown = ERROR, Diagnosis("stands_unknown")
            elif "hold" in decision.interlocks:
                shown = Diagnosis("stop_not_followed")
        diagnose(
            "pump", shown and replace(shown, text=str(decision.shown)), str(decision.shown), level,
            self._cause(first.code) if first else "", log=False,
        )
        warnings = join_diagnoses(decision.warnings)
        diagnose("limits", warnings, "nothing limits the pump", WARN, log=False)
        if doses.allowed:
            self._diagnose_dose(doses.last)
        diagnose("flow", second_pump, f"source: {decision.source}")
        self._diagnose_inputs(decision)
        levels_known = self._inputs["cistern_level"].good and self._inputs["roof_level"].good
        diagnose(
            "delivery",
            None if levels_known else Diagnosis.of("delivery_blind"),
            "the pumped volume is compared with both levels" if decision.delivery_checked
            else "the levels have not yet been known for long enough",
            WARN,
        )
        self._diagnose_drive(now)

    def _diagnose_inputs(self, decision: Decision) -> None:
        parts: dict[str, list[str]] = {}
        for row in INPUTS:
            if part := read_interlocks()[row.unknown].input if row.unknown else "":
                parts.setdefault(part, []).append(row.name)
        for part, names in parts.items():
            diagnosis, level = bad_inputs(self._inputs[name] for name in names), ERROR
            if diagnosis is None:  # a good value may still keep the pump off
                level, diagnosis = WARN, next((
                    reason for code, reason in decision.interlocks.items()
                    if part in read_interlocks()[code].explained_by
                ), None)
            elif part == "frost":
                level, diagnosis = WARN, diagnosis.change_code(self._cause("frost_unknown"))
            well = " and ".join(name.replace("_", " ") for name in names)
            self._reports.diagnose(part, diagnosis, f"known: {well}", level)

    def _cause(self, code: str) -> str:
        """Return the code that caused an interlock; empty if unknown."""
        diagnosis = bad_inputs(self._inputs[row.name] for row in INPUTS if row.unknown == code)
        if diagnosis is None:
            return ""
        unknown = code == "frost_unknown" and diagnosis.code == "input_refused"  # NaN means unknown
        return "temperature_unknown" if unknown else diagnosis.code

    def _diagnose_dose(self, dose: Dose | None) -> None:
        """Report the progress of a dose and, for a minute after its end, its outcome."""
        if dose is None:
            self._reports.diagnose("dose", None, "no dose is under way", log=False)
            return
        early = dose.ended_early if dose.over not in ("", DONE) else None
        self._reports.diagnose("dose", early, dose.sentence, WARN, dose.cause, log=False)

    def _diagnose_drive(self, now: float) -> None:
        snapshot = self._exchange.snapshot
        status, absence = snapshot.status_at(now), snapshot.absence_at(now)
        file = self._exchange.endpoint.file
        if unverified := ", ".join(file.unverified_and_vital):
            self._reports.diagnose("drive file", Diagnosis.of(
                "drive_file_unverified", file=str(file.path), settings=unverified
            ), level=WARN)
        if absence is not None:
            lost = bool(snapshot.errors)
            self._reports.diagnose(
                "drive", absence if lost else absence.change_code("drive_awaited"),
                level=ERROR if lost else WARN,
            )
        if status is None:
            return
        self._reports.hardware = f"{snapshot.identity}, {self._exchange.endpoint}"
        warning = "; ".join(filter(None, (snapshot.problem, status.warning)))
        level, diagnosis = WARN, None
        if status.fault:
            level, diagnosis = ERROR, drive_fault(status.fault, status.runs_on)
        elif not status.remote:
            more = {"problem": warning} if warning else {}
            diagnosis = Diagnosis.of("drive_local", "local", *more, **more)
        elif snapshot.second_master:
            diagnosis = snapshot.second_master
        elif warning:
            diagnosis = Diagnosis.of("drive_warning", warning=warning)
        self._reports.diagnose("drive", diagnosis, f"connected to {snapshot.identity}", level)
        self._diagnose_timeout(snapshot)

    def _diagnose_timeout(self, snapshot: DriveSnapshot) -> None:
        guard = self._exchange.endpoint.guard
        well = f"if this computer fails, the drive stops after {snapshot.timeout_s or 0:g} s"
        if guard is not None and guard.traps:
            well += f"; beware: {guard.traps}"
        diagnosis, level = self._exchange.timeout_problem(snapshot), ERROR
        if diagnosis is None:
            diagnosis, level = snapshot.unguarded, WARN
        self._reports.diagnose("drive timeout", diagnosis, well, level)
