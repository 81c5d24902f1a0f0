"""What a check of somebody's data found: a code, how grave it is, and the figures that say so."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_yaml


class Severity(Enum):
    """What follows from a finding."""

    REFUSAL = "refusal"
    """the data are not used, unless the finding's code is accepted"""
    WARNING = "warning"
    """they are used, and everybody who sees the result is warned"""
    NOTE = "note"
    """it is worth knowing"""


@dataclass(frozen=True)
class Finding:
    """One thing that a check found.

    Attributes:
        code: of its kind, for ``--accept`` and for programs.
        case: which of the cases of that code.
        about: what it is about, such as a column of a record.
        figures: what it rests on, by name.
        severity: what follows from it.
        sentence: for people, with the names of figures in braces.
    """

    code: str
    case: str
    about: str
    figures: Mapping[str, float | str]
    severity: Severity
    sentence: str

    @property
    def text(self) -> str:
        """The sentence with its figures."""
        return f"{self.about}: {self.sentence.format(**self.figures)}"


class Findings:
    """The table of what some checks can find: codes, and the sentence of each case."""

    def __init__(self, file: Path) -> None:
        """Read the table, in which each code has ``severity``, ``when`` and sentences by case."""
        self._rows: Mapping[str, Mapping[str, Any]] = read_yaml(file)

    @property
    def refusals(self) -> dict[str, str]:
        """The codes that can be accepted, and when there is such a finding."""
        refusal = Severity.REFUSAL.value
        return {
            code: row["when"] for code, row in self._rows.items() if row["severity"] == refusal
        }

    def make(self, code: str, case: str, about: str, **figures: float | str) -> Finding:
        """Return a finding of the table with its figures."""
        row = self._rows[code]
        return Finding(code, case, about, figures, Severity(row["severity"]), row[case])


def accept(findings: Sequence[Finding], accepted: Collection[str], file: Path) -> list[Finding]:
    """Return findings, in which refusals that are accepted are warnings and say so.

    Args:
        findings: of all checks.
        accepted: codes that a user has looked into.
        file: with the data.

    Raises:
        ConfigurationError: there are refusals that nobody accepted: a line for each, and the option
            that accepts them.
    """
    grave = [finding for finding in findings if finding.severity is Severity.REFUSAL]
    refused = [finding for finding in grave if finding.code not in accepted]
    if refused:
        codes = " ".join(dict.fromkeys(finding.code for finding in refused))
        lines = [f"{finding.text} [{finding.code}]" for finding in refused]
        raise ConfigurationError(
            "\n  ".join([*lines, f"where this is right all the same: --accept {codes}"]), file=file
        )
    return [
        replace(
            finding, severity=Severity.WARNING, about=f"{finding.about} ({finding.code}, accepted)"
        ) if finding in grave else finding
        for finding in findings
    ]
