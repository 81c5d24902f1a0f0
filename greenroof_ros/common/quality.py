"""What a check of a user's data found: a code, its severity, and the figures that show it."""

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
    """the data are used, and everybody who sees the result is warned"""
    NOTE = "note"
    """worth knowing"""


@dataclass(frozen=True)
class Finding:
    """One thing that a check found.

    Attributes:
        code: the kind of finding, for ``--accept`` and for programs.
        case: which case of that code.
        about: what it is about, such as a column of a record.
        figures: the values that show it, by name.
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
    """The table of what checks can find: codes, and a sentence for each case."""

    def __init__(self, file: Path) -> None:
        """Read the table, in which each code has ``severity``, ``when`` and sentences by case."""
        self._rows: Mapping[str, Mapping[str, Any]] = read_yaml(file)

    @property
    def refusals(self) -> dict[str, str]:
        """The codes that can be accepted, each with when there is such a finding."""
        refusal = Severity.REFUSAL.value
        return {
            code: row["when"] for code, row in self._rows.items() if row["severity"] == refusal
        }

    def make(self, code: str, case: str, about: str, **figures: float | str) -> Finding:
        """Return a finding from the table, with its figures."""
        row = self._rows[code]
        return Finding(code, case, about, figures, Severity(row["severity"]), row[case])


def accept(findings: Sequence[Finding], accepted: Collection[str], file: Path) -> list[Finding]:
    """Return the findings, with accepted refusals turned into warnings that report it.

    Args:
        findings: of all checks.
        accepted: codes that a user has looked into.
        file: with the data.

    Raises:
        ConfigurationError: some refusals are not accepted. The message has a line for each, and the
            option that accepts them.
    """
    grave = [finding for finding in findings if finding.severity is Severity.REFUSAL]
    refused = [finding for finding in grave if finding.code not in accepted]
    if refused:
        codes = " ".join(dict.fromkeys(finding.code for finding in refused))
        lines = [f"{finding.text} [{finding.code}]" for finding in refused]
        raise ConfigurationError(
            "\n  ".join([*lines, f"if the data are right anyway: --accept {codes}"]), file=file
        )
    return [
        replace(
            finding, severity=Severity.WARNING, about=f"{finding.about} ({finding.code}, accepted)"
        ) if finding in grave else finding
        for finding in findings
    ]
