"""What a check of somebody's own part found, and its table on the screen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table

from greenroof_ros.common.command_line import EXIT_DONE, EXIT_FAILED


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes:
        check: what the part must do.
        problem: what this one does instead; empty where it is right.
        came: what it did, where that is right and worth a number.
    """

    check: str
    problem: str
    came: str = ""


def print_findings(title: str, findings: Sequence[Finding]) -> int:
    """Print findings as a table, and return the exit code: whether all is right."""
    table = Table(title=title, title_justify="left")
    for name in ("check", "result"):
        table.add_column(name)
    for finding in findings:
        right = f"right: {finding.came}" if finding.came else "right"
        table.add_row(finding.check, finding.problem or right)
    Console().print(table)
    failed = [finding for finding in findings if finding.problem]
    print(f"{len(findings) - len(failed)} of {len(findings)} checks passed")
    return EXIT_FAILED if failed else EXIT_DONE
