"""Run EPA's SWMM 5, for the tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

from swmm.toolkit import solver

Result = TypeVar("Result")


class Errors(NamedTuple):
    """Continuity errors of SWMM: shares of the water that it loses (%)."""

    runoff: float
    routing: float


def run_swmm(
    model: Path, read: Callable[[], Result], after_step: Callable[[], None] = lambda: None
) -> tuple[Result, Errors]:
    """Run a model to its end.

    Args:
        model: SWMM's input file; its report is written next to it.
        read: function that reads results from the solver at the end.
        after_step: function that is called after every step.

    Returns:
        The results that were read, and SWMM's continuity errors.
    """
    solver.swmm_open(*(str(model.with_suffix(suffix)) for suffix in (".inp", ".rpt", ".out")))
    try:
        solver.swmm_start(0)
        while solver.swmm_step():
            after_step()
        result = read()
        solver.swmm_end()
        runoff, routing, _ = solver.swmm_get_mass_balance()
    finally:
        solver.swmm_close()
    return result, Errors(float(runoff), float(routing))
