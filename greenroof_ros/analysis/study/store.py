"""The directory of a study: its inputs, its finished runs, and the table."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from greenroof_ros.analysis.study.case import Case, collect_contents
from greenroof_ros.analysis.study.case_run import Outcome
from greenroof_ros.analysis.study.names import Names
from greenroof_ros.analysis.workers.input_files import write_inputs
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import add_path_to_errors, replace_text
from greenroof_ros.base.processes import LockedError, lock_file
from greenroof_ros.forecast.skill import REAL, read_skill
from greenroof_ros.physics.sensor_and_pump import SensorAndPump
from greenroof_ros.results.table import format_csv, parameter_columns
from greenroof_ros.results.versions import versions

_OUTCOME = "outcome.json"
_DIGEST = "digest"
_LOCK = ".lock"


class StudyStore:
    """The store of a study's outcomes, each of which is stored completely or not at all.

    Attributes:
        directory: directory of the study.
        cases: runs of the study.
        trajectory_every: time between the samples of each run's trajectory (s), 0 for every tick;
            None to keep only the results.
        outcomes: outcomes of finished runs, without their files, by identity.
        failures: reasons why runs failed, by identity; a run that is neither in ``outcomes`` nor in
            ``failures`` was not run.
        bounds: columns of the known minimum deviations and discharges, by the bound_identity and
            the discharge_bound_identity of their cases.
    """

    def __init__(
        self,
        directory: Path,
        grid: Path,
        cases: Sequence[Case],
        *,
        trajectory_every: float | None,
    ) -> None:
        """Start a new study, or continue an existing study.

        A damaged outcome, for instance after a power cut, is discarded: the run is repeated, and
        the new outcome replaces the damaged one.

        Args:
            directory: directory of the study: new, empty, or from an earlier start of the same
                study.
            grid: file of the grid.
            cases: runs of the study.
            trajectory_every: time between the samples of each trajectory, as for the attribute of
                the same name.

        Raises:
            ConfigurationError: if the directory contains other files, or a study with another grid,
                trajectories or code; if it cannot be written to; if another process is using it; or
                if an outcome exists but cannot be read, for instance on a network drive. An outcome
                that cannot be read is kept.
        """
        self.directory = directory
        self._held = ExitStack()  # the lock, for as long as this object exists
        self.cases, self.trajectory_every = cases, trajectory_every
        self._runs = directory / "runs"
        self._bounds = directory / "bounds.json"
        identity = {
            "trajectory_every": trajectory_every,
            "versions": {**versions(), "skill": repr(read_skill(REAL))},
            "runs": [case.identity for case in cases],
        }
        try:
            self._open(grid, identity)
        except OSError as error:
            raise ConfigurationError(
                f"cannot be read or written: {error.strerror}", key="--output", value=str(directory)
            ) from error
        self.outcomes: dict[str, Outcome] = {}
        self.failures: dict[str, str] = {}
        for case in cases:
            content = _read(self._runs / case.identity / _OUTCOME)
            if content:
                self.outcomes[case.identity] = Outcome(**content, files={})
        self.bounds: dict[str, dict[str, float]] = _read(self._bounds)

    def _open(self, grid: Path, identity: dict[str, Any]) -> None:
        configuration = self.directory / "configuration"
        file = configuration / "study.json"
        self.directory.mkdir(parents=True, exist_ok=True)
        there = {path.name for path in self.directory.iterdir()}
        # A study that was killed at its start leaves its lock, and perhaps a partial configuration.
        killed = _LOCK in there and there <= {_LOCK, configuration.name}
        if there and not killed and not file.is_file():
            raise ConfigurationError(
                "exists and is neither empty nor a study, so it was left unchanged",
                key="--output", value=str(self.directory),
            )
        try:
            self._held.enter_context(lock_file(self.directory / _LOCK))
        except LockedError:
            raise ConfigurationError(
                "is in use by another process", key="--output", value=str(self.directory)
            ) from None
        configuration.mkdir(exist_ok=True)
        if file.is_file():
            self._check(file, identity)
        else:
            shutil.copyfile(grid, configuration / "grid.yaml")
            write_inputs(collect_contents(self.cases), configuration)
            replace_text(file, json.dumps(identity, indent=2) + "\n")
        self._runs.mkdir(exist_ok=True)
        for cut_short in self._runs.glob("*.part"):
            shutil.rmtree(cut_short)

    def _check(self, file: Path, identity: dict[str, Any]) -> None:
        """Reject a study that was started with a different identity.

        Raises:
            ConfigurationError: if the study's file is damaged, or differs in the identity.
        """
        try:
            begun = json.loads(file.read_text(encoding="utf-8"))
        except (ValueError, RecursionError) as error:
            raise ConfigurationError(f"is not valid JSON: {error}", file=file) from error
        for key, what in (
            ("runs", "another grid, or other files"),
            ("trajectory_every", "other trajectories, or without trajectories"),
            ("versions", "other versions of the code or its packages"),
        ):
            if not isinstance(begun, dict) or begun.get(key) != identity[key]:
                raise ConfigurationError(
                    f"contains a study that was started with {what}; continue it with the "
                    "original inputs, or choose another directory",
                    key="--output", value=str(self.directory),
                )

    def write_outcome(self, case: Case, outcome: Outcome) -> None:
        """Write an outcome atomically: it exists only once it has been written completely.

        Raises:
            OSError: if writing fails, for instance because the disk is full.
        """
        part, whole = self._runs / f"{case.identity}.part", self._runs / case.identity
        about = _with_digest({"results": outcome.results})
        part.mkdir(exist_ok=True)
        for name, content in {**outcome.files, _OUTCOME: about.encode()}.items():
            with add_path_to_errors(part / name):
                (part / name).write_bytes(content)
        if whole.exists():  # a damaged outcome
            shutil.rmtree(whole)
        part.replace(whole)
        self.outcomes[case.identity] = replace(outcome, files={})

    def write_bound(self, identity: str, columns: dict[str, float]) -> None:
        """Store the columns of a bound, under its identity."""
        self.bounds[identity] = columns
        replace_text(self._bounds, _with_digest(self.bounds))

    def write_table(self) -> list[dict[str, Any]]:
        """Write ``results.csv``, and return its rows."""
        parameters = dict.fromkeys(name for case in self.cases for name in case.inputs.parameters)
        imperfect = any(case.inputs.sensor_and_pump != SensorAndPump() for case in self.cases)
        rows, names = [], Names(self.cases)
        for case in self.cases:
            inputs = case.inputs
            error = self.failures.get(case.identity)
            outcome = self.outcomes.get(case.identity)
            bound = self.bounds.get(case.bound_identity, {}).get("bound_m3")
            results = {} if outcome is None else outcome.results
            rows.append({
                "run": case.identity,
                **names.columns(case),
                **case.columns(),
                **(inputs.sensor_and_pump.values() if imperfect else {}),
                **parameter_columns({name: inputs.parameters.get(name) for name in parameters}),
                "status": "done" if outcome else "not run" if error is None else "failed",
                "error": error or "",
                **results,
                "bound_m3": bound,
                "ratio_to_bound": results["total_deviation_m3"] / bound if results and bound
                else None,
                **self.bounds.get(case.discharge_bound_identity, {}),
            })
        columns = dict.fromkeys(column for row in rows for column in row)
        replace_text(self.directory / "results.csv", format_csv(columns, rows))
        return rows


def _with_digest(values: Mapping[str, Any]) -> str:
    """Return values as JSON, with a digest that reveals any later damage."""
    text = json.dumps(values, sort_keys=True)
    about = {**values, _DIGEST: hashlib.sha256(text.encode()).hexdigest()}
    return json.dumps(about, indent=2) + "\n"


def _read(file: Path) -> dict[str, Any]:
    """Return the values that :func:`_with_digest` wrote; empty if the file is missing or damaged.

    Raises:
        ConfigurationError: if the file exists but cannot be read.
    """
    try:
        text = file.read_text(encoding="utf-8")
        values = {**json.loads(text)}
        del values[_DIGEST]
        return values if _with_digest(values) == text else {}
    except (FileNotFoundError, ValueError, TypeError, KeyError, RecursionError):
        return {}
    except OSError as error:
        raise ConfigurationError(
            f"cannot be read: {error.strerror}; the study is unchanged", file=file
        ) from error
