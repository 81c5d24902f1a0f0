"""The results of a check, as they are printed."""

from __future__ import annotations

from collections.abc import Iterable

from greenroof_ros.base.command_line import EXIT_DONE, EXIT_FAILED


def print_results(title: str, results: Iterable[tuple[str, str, str]]) -> int:
    """Print results as they come, and return exit code 0 if every check passed, otherwise 1.

    Args:
        title: the first line.
        results: for each check what it requires, the problem (empty if it passed), and what was
            measured (may be empty).
    """
    print(title)
    outcomes = []
    for check, problem, measured in results:
        outcomes.append("failed" if problem else "passed")
        print(f"  {outcomes[-1]}: {': '.join(filter(None, (check, problem or measured)))}")
    print(f"{outcomes.count('passed')} of {len(outcomes)} checks passed")
    return EXIT_FAILED if "failed" in outcomes else EXIT_DONE
