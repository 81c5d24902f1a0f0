"""How far forecasts were trusted, day by day: a figure of /controller/trust in the runs."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import altair as alt
import vl_convert
from real_seasons.runs import ISSUED
from real_seasons.tables import Results

from greenroof_ros.report.drawing import COLOURS, CONFIG


def draw(results: Results, file: Path) -> None:
    """Draw the trust of runs that learned it with forecasts as issued, if there are any."""
    values = [
        {
            "day": (case.period.start + timedelta(days=day)).isoformat(),
            "trust (%)": 100 * trust, "forecast": case.source,
        }
        for case, result in results.items()
        if case.form == ISSUED and case.trusts and case.hour and result["trust"][0] is not None
        for day, trust in enumerate(result["trust"])
    ]
    if not values:
        return
    order = list(dict.fromkeys(value["forecast"] for value in values))
    chart = alt.Chart(alt.Data(values=values)).mark_line(interpolate="step-after").encode(
        x=alt.X("day:T", title=None),
        y=alt.Y("trust (%):Q", scale=alt.Scale(domain=[0, 100])),
        color=alt.Color(
            "forecast:N", sort=order, scale=alt.Scale(range=list(COLOURS)), legend=None
        ),
        row=alt.Row("forecast:N", sort=order, title=None),
    ).properties(width=600, height=60).configure(**CONFIG)
    file.write_text(vl_convert.vegalite_to_svg(chart.to_dict()), encoding="utf-8")
