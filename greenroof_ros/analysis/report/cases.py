"""The cases of a report: runs that differ only in their seeds and, for a season, in the year."""

from __future__ import annotations

import polars

from greenroof_ros.analysis.report.runs import Sources
from greenroof_ros.analysis.tables import BOUNDS, COLUMNS, TOTAL, choose_metrics
from greenroof_ros.results.table import make_frame

# Metrics of which more is better.
_MORE = {
    "near_target_hours", "evapotranspiration_ratio", "roof_retention_share", "demand_met_share",
    "retention_share",
}


class Report:
    """All results, grouped into cases.

    Attributes:
        sources: where the runs are from.
        show: the known metrics by which the cases are sorted, the most important one first.
        metrics: all metrics of which a result is known.
        years: the mean of each metric in each year, for each ``place`` and ``case``; the year is
            null for runs of no season.
        places: a table for each window and initial state, with a row for each case, the best first:
            ``case``; ``place``, in what the window and the state differ from the others; the mean
            of each metric, with the lowest and the highest run in ``..._min`` and ``..._max``; the
            number of ``runs``, and the index of the ``first`` one.
    """

    def __init__(self, sources: Sources) -> None:
        """Group and compare the runs."""
        self.sources = sources
        show = sources.show or choose_metrics(run.site for run in sources.runs)
        keys = "case", *COLUMNS, *BOUNDS.values()
        windows, states = ({run.row[key] for run in sources.runs} for key in ("window", "initial"))
        rows = make_frame([{
            **{key: run.row.get(key) for key in keys}, "first": first,
            "place": ", ".join([
                *[run.row["window"]] * (len(windows) > 1),
                *[f"initial state {run.row['initial']}"] * (len(states) > 1),
            ]),
            "year": int(run.row["start"][:4]) if run.row.get("season") else None,
        } for first, run in enumerate(sources.runs)], infer_schema_length=None)
        known = [name for name in keys[1:] if rows[name].null_count() < len(rows)]
        self.metrics = [name for name in COLUMNS if name in known]
        self.show = [name for name in show if name in known] or [TOTAL]
        case, values = ["place", "case"], polars.col(known)
        self.years = rows.group_by(*case, "year", maintain_order=True).agg(values.mean())
        means = self.years.group_by(case, maintain_order=True).agg(values.mean())
        ranges = rows.group_by(case).agg(
            values.min().name.suffix("_min"), values.max().name.suffix("_max"),
            polars.len().alias("runs"), polars.col("first").first(),
        )
        self.places = [
            place.sort(map(rank, self.show), nulls_last=True, maintain_order=True)
            for place in means.join(ranges, on=case, maintain_order="left").partition_by(
                "place", maintain_order=True
            )
        ]


def rank(metric: str) -> polars.Expr:
    """Return a number that is the lower, the better a metric is."""
    return -polars.col(metric) if metric in _MORE else polars.col(metric)
