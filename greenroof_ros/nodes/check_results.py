"""The results of a check, and how they are printed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from greenroof_ros.base.command_line import EXIT_DONE, EXIT_FAILED


@dataclass(frozen=True)
class CheckResult:
    """The result of one check.

    Attributes:
        check: the requirement that is checked.
        problem: description of the deviation from the requirement; empty if the check passed.
        result: result to show for a passed check; empty for none.
    """

    check: str
    problem: str
    result: str = ""


def print_check_results(title: str, results: Sequence[CheckResult]) -> int:
    """Print results, and return exit code 0 if every check passed, otherwise 1."""
    print(title)
    for result in results:
        outcome = "failed" if result.problem else "passed"
        shown = ": ".join(filter(None, (result.check, result.problem or result.result)))
        print(f"  {outcome}: {shown}")
    passed = sum(not result.problem for result in results)
    print(f"{passed} of {len(results)} checks passed")
    return EXIT_DONE if passed == len(results) else EXIT_FAILED
