"""The results of a check, as they are printed."""

from __future__ import annotations

from collections.abc import Iterable

from greenroof_ros.base.command_line import EXIT_DONE, EXIT_FAILED

NODE = "check the running node of this name, with its namespace if it has one: /site1/pump"
"""help of the option for the node that a command checks"""


def print_results(title: str, results: Iterable[tuple[str, str]]) -> int:
    """Print results as they come, and return exit code 0 if every check passed, otherwise 1.

    Args:
        title: the first line.
        results: for each check what it requires, and the problem; empty if it passed.
    """
    print(title)
    problems = []
    for check, problem in results:
        problems.append(problem)
        print(f"  failed: {check}: {problem}" if problem else f"  passed: {check}")
    print(f"{problems.count('')} of {len(problems)} checks passed")
    return EXIT_FAILED if any(problems) else EXIT_DONE
