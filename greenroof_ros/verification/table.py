"""The scores of a verification as a table: on the terminal, and as CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping

from rich import box
from rich.table import Table

from greenroof_ros.verification.pairs import Class
from greenroof_ros.verification.scores import Scores, Tally

# Name of each score, and how it is shown.
SHOWN = {
    "n": "d", "bias": ".2f", "r": ".2f", "pod": ".2f", "far": ".2f", "ets": ".2f",
    "brier": ".3f", "crps": ".3f",
}


def terminal_table(title: str, tallies: Mapping[Class, Tally]) -> Table:
    """Return what a person sees."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("lead", no_wrap=True)
    for name in ("sum of", "event", *map(heading, SHOWN)):
        table.add_column(name, justify="right", no_wrap=True)
    before = ""
    for one, tally in tallies.items():
        scores = tally.scores()
        table.add_row(
            one.lead if one.lead != before else "", f"{one.sum.hours} h", f"{one.sum.event:g} mm",
            *(shown(name, scores) for name in SHOWN),
        )
        before = one.lead
    return table


def heading(name: str) -> str:
    """Return how a score is called where people read it."""
    if name in ("pod", "far", "ets"):
        return name.upper()
    return {"brier": "Brier", "crps": "CRPS mm"}.get(name, name)


def shown(name: str, scores: Scores) -> str:
    """Return a score as it is shown; a dash where there is none."""
    value = getattr(scores, name)
    return "-" if math.isnan(value) else format(value, SHOWN[name])


def csv_text(tallies: Mapping[Class, Tally]) -> str:
    """Return all scores as CSV, a line for each class; an empty cell where there is none."""
    stream = io.StringIO()
    rows = csv.writer(stream, lineterminator="\n")
    rows.writerow(
        ("lead_from_h", "lead_to_h", "sum_hours", "event_mm",
         *("crps_mm" if name == "crps" else name for name in SHOWN))
    )
    for one, tally in tallies.items():
        scores = tally.scores()
        rows.writerow(
            (one.low, one.high, one.sum.hours, f"{one.sum.event:g}", scores.n,
             *("" if math.isnan(value) else f"{value:.6g}" for value in scores[1:]))
        )
    return stream.getvalue()
