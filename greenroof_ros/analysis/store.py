"""The directory of a study: its inputs, its finished runs, and the table."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from greenroof_ros.analysis.case import Case, Outcome, name_cases
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import add_path_to_errors, replace_text
from greenroof_ros.base.processes import LockedError, lock_file
from greenroof_ros.base.versions import versions
from greenroof_ros.forecast.choice import REAL, read_skill
from greenroof_ros.results.table import format_csv, parameter_columns
from greenroof_ros.results.trajectory import TRAJECTORY
from greenroof_ros.site.file import format_site

_OUTCOME, _LOCK = "outcome.json", ".lock"


class StudyStore:
    """The store of a study's outcomes, each of which is stored completely or not at all.

    Attributes:
        directory: directory of the study.
        inputs: directory of the study's configuration, with the input files of its cases.
        cases: runs of the study.
        trajectory_every: time between the samples of each run's trajectory (s), 0 for every tick;
            None to keep only the results.
        results: columns of finished runs, by identity.
        failures: reasons why runs failed, by identity; a run that is neither in ``results`` nor in
            ``failures`` was not run.
        bounds: columns of the known minimum possible values, by identity of the plain cases.
    """

    def __init__(
        self, directory: Path, cases: Sequence[Case], contents: Mapping[str, bytes], *,
        trajectory_every: float | None = None, show: Sequence[str] = (),
    ) -> None:
        """Start a new study, or continue an existing study.

        A run whose outcome a power cut has cut short is repeated.

        Args:
            directory: directory of the study: new, empty, or from an earlier start of the same
                study.
            cases: runs of the study.
            contents: contents of all files to keep with the study, by name.
            trajectory_every: as for the attribute of the same name.
            show: metrics that the study asks for.

        Raises:
            ConfigurationError: if the directory contains other files, or a study with other cases,
                trajectories or code, or if another process is using it.
            OSError: if the directory cannot be written to, or if an outcome exists but cannot be
                read, for instance on a network drive; the outcome is kept.
        """
        self.directory, self.inputs = directory, directory / "configuration"
        self.cases, self.trajectory_every, self.show = cases, trajectory_every, show
        self._held = ExitStack()  # the lock, for as long as this object exists
        self._runs, self._bounds = directory / "runs", directory / "bounds.json"
        self._names = dict(zip((case.identity for case in cases), name_cases(cases), strict=True))
        self._open(contents)
        self.failures: dict[str, str] = {}
        outcomes = {case.identity: _read(self._runs / case.identity / _OUTCOME) for case in cases}
        self.results = {name: results for name, results in outcomes.items() if results}
        self.bounds: dict[str, dict[str, float]] = _read(self._bounds)

    def _refuse(self, expected: str) -> ConfigurationError:
        return ConfigurationError(expected, key="--output", value=str(self.directory))

    def _open(self, contents: Mapping[str, bytes]) -> None:
        identity = {
            "show": [*self.show],
            "trajectory_every": self.trajectory_every,
            "versions": {**versions(), "skill": repr(read_skill(REAL))},
            "runs": [case.identity for case in self.cases],
        }
        file = self.inputs / "study.json"
        self.directory.mkdir(parents=True, exist_ok=True)
        there = {path.name for path in self.directory.iterdir()}
        # A study that was killed at its start leaves its lock, and perhaps a partial configuration.
        killed = _LOCK in there and there <= {_LOCK, self.inputs.name}
        if there and not killed and not file.is_file():
            raise self._refuse("exists and is neither empty nor a study, so it was left unchanged")
        try:
            self._held.enter_context(lock_file(self.directory / _LOCK))
        except LockedError:
            raise self._refuse("is in use by another process") from None
        self.inputs.mkdir(exist_ok=True)
        if file.is_file():
            begun = _read(file)
            if other := [key for key in identity if begun.get(key) != identity[key]]:
                raise self._refuse(
                    f"contains a study that was started with other {other[0]}; continue it with "
                    "the original inputs, or choose another directory"
                )
        else:
            sites = {
                self._names[case.identity]["site"]: format_site(case.site).encode()
                for case in self.cases
            }
            for name, content in (sites | {**contents}).items():
                with add_path_to_errors(self.inputs / name):
                    (self.inputs / name).write_bytes(content)
            replace_text(file, json.dumps(identity, indent=2) + "\n")
        self._runs.mkdir(exist_ok=True)

    def name(self, case: Case) -> str:
        """Return the name of a case: what differs from the others."""
        names = self._names[case.identity]
        return ", ".join([names["window"], names["case"], f"from {case.inputs.initial}"])

    def write_outcome(self, case: Case, outcome: Outcome) -> None:
        """Write an outcome atomically: it exists only once it has been written completely.

        Raises:
            OSError: if writing fails, for instance because the disk is full.
        """
        part, whole = self._runs / f"{case.identity}.part", self._runs / case.identity
        part.mkdir(exist_ok=True)
        if outcome.trajectory is not None:
            with add_path_to_errors(part / TRAJECTORY):
                (part / TRAJECTORY).write_bytes(outcome.trajectory)
        replace_text(part / _OUTCOME, json.dumps(outcome.results, indent=2))
        shutil.rmtree(whole, ignore_errors=True)  # after a power cut
        part.replace(whole)
        self.results[case.identity] = outcome.results

    def write_bound(self, identity: str, columns: dict[str, float]) -> None:
        """Store the columns of a bound, under its identity."""
        self.bounds[identity] = columns
        replace_text(self._bounds, json.dumps(self.bounds, indent=2))

    def write_table(self) -> list[dict[str, Any]]:
        """Write ``results.csv``, and return its rows."""
        parameters = dict.fromkeys(name for case in self.cases for name in case.inputs.parameters)
        rows = []
        for case in self.cases:
            inputs, identity = case.inputs, case.identity
            results, error = self.results.get(identity), self.failures.get(identity)
            bounds = self.bounds.get(case.plain.identity, {})
            rows.append({
                "run": identity, **self._names[identity], **case.columns(),
                **parameter_columns({name: inputs.parameters.get(name) for name in parameters}),
                "status": "done" if results else "not run" if error is None else "failed",
                "error": error or "", **(results or {}), **bounds,
            })
        columns = dict.fromkeys(column for row in rows for column in row)
        replace_text(self.directory / "results.csv", format_csv(columns, rows))
        return rows


def _read(file: Path) -> dict[str, Any]:
    """Return the content of a JSON file; empty if it is missing, or was cut short by a power cut.

    Raises:
        OSError: if the file exists but cannot be read.
    """
    with suppress(FileNotFoundError, ValueError):
        return {**json.loads(file.read_text(encoding="utf-8"))}
    return {}
