"""How a report groups its runs: a table with a row for each run, and its cases.

Runs that differ only in the seed of their forecasts' errors are one case. Runs of a week or more
that are the same season of several years are one case, together with their seeds. Every other run
is a case of its own. All statements of a report are about cases.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np
import polars as pl

from greenroof_ros.analysis.report.bags import Drawn, drawn, measured, near_hours
from greenroof_ros.analysis.report.intervals import Deviations, compare, worst_tenth
from greenroof_ros.analysis.report.run import (
    NO_ERRORS,
    PAPERS_CONTROLLERS,
    Assumptions,
    Note,
    ReportedRun,
    Row,
    controller_name,
    parameter_text,
)
from greenroof_ros.analysis.report.sources import Sources
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.forecast.choice import PERFECT
from greenroof_ros.forecast.skill import SKILLS
from greenroof_ros.model.metrics import METRICS, NEAR_TARGET
from greenroof_ros.recording.results_table import differing

SINGLE, SEEDS, SEASONS = "single", "seeds", "seasons"
"""the kinds of cases"""

TOTAL = "total_deviation_m3"

# Runs are compared if they agree in these columns, which are also headers on the page.
_WINDOW = (
    "site", "weather", "start", "length", "evapotranspiration", "forecast",
    "sensor and pump errors",
)
SKY = _WINDOW[:4]
"""windows that agree in these columns share a figure of the weather"""
_SEASON = ("site", "from", "start", "length", "evapotranspiration", "sensor and pump errors")
_FACTS = {SINGLE: _WINDOW, SEEDS: _WINDOW, SEASONS: _SEASON}

_NUMBERS = (
    *(metric.name for metric in METRICS), "frost_hours", "frost_pumped_m3", "cistern_change_m3",
    "roof_change_m3", "cistern_residual_m3", "roof_residual_m3", "energy_cost", "water_value",
    "near_share",
)
_TEXTS = (
    "run", "site", "weather", "start", "length", "evapotranspiration", "forecast", "model",
    "kind of forecast", "skill", "seed", "sensor and pump errors", "controller", "from", "begins",
    "kind", "label", "setting", "ended",
)
_SCHEMA: dict[str, Any] = {
    **dict.fromkeys(_TEXTS, pl.String), "season": pl.List(pl.Float64),
    **dict.fromkeys(("year", "rank", "skill rank"), pl.Int64),
    **dict.fromkeys(
        ("hours", "cistern_m3", "roof_m3", "bound_m3", "tau", "initial_layer", "roof_m2",
         "cistern_size_m3", *_NUMBERS),
        pl.Float64,
    ),
}
# A rank is a controller's place times this, plus the place of the setting; no controller has more.
_SETTINGS = 10_000
# Named skills from the best to the worst, after forecasts without a skill and before skill files.
_SKILLS = {skill: rank for rank, skill in enumerate(("", *SKILLS))}
# The parameters that depend on a site's size: areas, the cistern's depth, and volumes.
_BY_SIZE = {
    "a1", "a2", "z_o", "x2_star", "z_cap", "initial_cistern", "initial_roof", "initial_layer",
}


def heading(row: Row, apart: Sequence[str], names: Sequence[str] = ()) -> str:
    """Name a set of runs by the facts that distinguish it from others, and by unusual facts.

    Args:
        row: of a run in the set.
        apart: the facts that distinguish it, as column headers.
        names: the facts to use; by default all of its kind.
    """
    usual = {"site": row["site"], "forecast": PERFECT, "sensor and pump errors": NO_ERRORS}
    facts = {name: row[name] for name in names or _FACTS[row["kind"]]}
    return ", ".join(
        f"{text} {name}" if name == "evapotranspiration"
        else f"{name} {text}" if name == "forecast" or text == NO_ERRORS else text
        for name, text in facts.items() if name in apart or text != usual.get(name)
    )


class Settings:
    """Labels of one controller's runs: the parameters that differ, or were changed during a run.

    Attributes:
        title: what a label shows: the parameter's name if there is just one, or ``setting``.
        labels: all labels, in the order of their values.
    """

    def __init__(self, runs: Sequence[ReportedRun]) -> None:
        changed = {name for run in runs for name in run.changes}
        apart = differing([run.parameters for run in runs])
        apart += sorted(changed.difference(apart))
        self._shown = apart or list(runs[0].parameters)[:1]
        self.title = self._shown[0] if len(self._shown) == 1 else "setting"

        def order(run: ReportedRun) -> tuple[list[tuple[float, str]], str]:
            values = map(run.parameters.get, self._shown)
            return [
                (value if isinstance(value, float) else math.inf, str(value)) for value in values
            ], self.label(run)

        self.labels = list(dict.fromkeys(map(self.label, sorted(runs, key=order))))

    def label(self, run: ReportedRun, *, full: bool = False) -> str:
        """Return the setting of a run: the parameters that differ between the controller's runs.

        Args:
            run: of the controller.
            full: whether to name the parameter even if there is just one. Without parameters the
                setting is then empty, and else ``none``.
        """
        texts = {
            name: parameter_text(run.parameters.get(name)) + run.changes.get(name, "")
            for name in self._shown
        }
        if len(texts) == 1 and not full:
            return texts[self.title]
        setting = ", ".join(f"{name} {text}" for name, text in texts.items())
        return setting if full else setting or "none"


class Report:
    """All results, and their grouping into cases.

    Attributes:
        table: a row for each run, with its kind and the numbers of its window, place and case. Each
            number is the index of its first run. A place is a window and an initial state.
        cases: a row for each case, place by place, ordered by controller, setting and skill.
        runs: by name.
        failed: runs without results.
        configuration: name and text of each further file that affects the results.
        drawn: curves of the runs that are cases of their own, by name.
        controllers: names, the paper's first.
        settings: by controller.
        assumptions: that the results are based on.
    """

    def __init__(
        self, sources: Sources, assumptions: Assumptions,
        track: Callable[[Sequence[ReportedRun]], Iterable[ReportedRun]] = iter,
    ) -> None:
        """Read and group runs.

        Args:
            sources: the runs.
            assumptions: that the runs do not state.
            track: shows the progress of reading runs.

        Raises:
            ConfigurationError: the trajectory of a finished run cannot be read, or no run is left.
        """
        self.assumptions = assumptions
        self.failed, self.configuration = list(sources.failed), sources.configuration
        self.drawn: dict[str, Drawn] = {}
        kinds, runs = _kinds([run.row for run in sources.runs]), []
        for kind, run in zip(kinds, track(sources.runs), strict=True):
            try:
                runs.append(self._read(run, kind))
            except ConfigurationError as error:
                if not run.ending:
                    raise
                reason = f"{run.ending}; {error}"
                self.failed.append(
                    {"run": run.name, "what": run.row["controller"], "error": reason}
                )
        if not runs:
            first, *_ = self.failed
            raise ConfigurationError(
                f"holds no finished run; {len(self.failed)} failed or did not run, the first: "
                f"{first['run']} {first['error']}"
            )
        self.runs = {run.name: run for run in runs}
        ran = list(dict.fromkeys(run.row["controller"] for run in runs))
        self.controllers = [name for name in PAPERS_CONTROLLERS if name in ran]
        self.controllers += [name for name in ran if name not in PAPERS_CONTROLLERS]
        self.settings = {
            name: Settings([run for run in runs if run.row["controller"] == name])
            for name in self.controllers
        }
        self.table = self._grouped(runs)
        self.cases = self._cases()

    def _read(self, run: ReportedRun, kind: str) -> ReportedRun:
        """Return a run with its kind; if it is a case of its own, also read its trajectory.

        The curves to draw are kept. For other runs, only the results in the study's table are used.
        """
        row, notes = {**run.row, "kind": kind}, list(run.notes)
        recorded = run.load() if kind == SINGLE and run.load is not None else None
        if recorded is not None:
            notes += map(Note, recorded.notes)
            self.drawn[run.name] = drawn(recorded.trajectory)
            if run.bound is not None:
                row |= measured(run, recorded)
        elif kind == SINGLE:
            notes.append(Note(
                "no trajectory was kept: no figure of weather, commands and volumes shows it"
            ))
        if self.assumptions.band != NEAR_TARGET:
            row["near_target_hours"] = None
            if recorded is not None:
                happened = recorded.trajectory
                spacing = float(np.diff(happened.time).max())
                if run.bound is None and spacing > 1.5 * run.site.tau:
                    notes.append(Note(
                        f"the time near the target is unknown: only samples every {spacing:g} s "
                        "were kept"
                    ))
                else:
                    row["near_target_hours"] = near_hours(run.site, happened, self.assumptions.band)
        return replace(run, row=row, notes=tuple(notes))

    def _grouped(self, runs: list[ReportedRun]) -> pl.DataFrame:
        """Return the table: names and results of the runs, and their window, place and case."""
        rows = []
        for run in runs:
            settings = self.settings[run.row["controller"]]
            label = settings.label(run)
            place = self.controllers.index(run.row["controller"])
            rows.append({
                **run.row, "tau": run.site.tau, "initial_layer": run.site.initial_layer,
                "roof_m2": run.site.a2, "cistern_size_m3": run.site.a1 * run.site.z_o,
                "label": label,
                "setting": settings.label(run, full=True),
                "rank": _SETTINGS * place + settings.labels.index(label),
                "skill rank": _SKILLS.get(run.row["skill"], len(_SKILLS)), "ended": run.ended,
            })
        table = pl.DataFrame(rows, schema=_SCHEMA)
        col, season = pl.col, pl.col("kind") == SEASONS
        table = table.with_columns(_derived(self.assumptions)).with_columns(
            start=pl.when(season).then("begins").otherwise("start"),
            weather=pl.when(season).then(pl.lit("")).otherwise("weather"),
            forecast=pl.when(season).then("kind of forecast")
            .when(col("kind") == SEEDS).then("model").otherwise("forecast"),
            year=pl.when(season).then("year"),
            index=pl.row_index(),
        )
        first = col("index").min()
        table = table.with_columns(
            window=pl.when(season).then(first.over("kind", *_SEASON))
            .otherwise(first.over("kind", *_WINDOW)),
        ).with_columns(place=first.over("window", "from"))
        # Only their names distinguish several runs of a controller without parameters in a place.
        several = pl.len().over("place", "controller") > 1
        nameless = (col("kind") == SINGLE) & (col("setting") == "") & several
        return table.with_columns(
            pl.when(nameless).then("run").otherwise(key).alias(key) for key in ("label", "setting")
        ).with_columns(
            case=pl.when(col("kind") == SINGLE).then("index").otherwise(
                first.over("place", "controller", "setting", "forecast", "skill")
            ),
        )

    def _cases(self) -> pl.DataFrame:
        """Return the means of each case's runs: over the seeds of each year, then over years."""
        table, col = self.table, pl.col
        yearly = table.group_by("case", "year", maintain_order=True).agg(
            col(_NUMBERS).mean(), col("bound_m3").first(), seeds=col("seed").n_unique(),
        )
        means = yearly.group_by("case", maintain_order=True).agg(
            col(_NUMBERS).mean(),
            bound_m3=pl.when((col("bound_m3").fill_null(0) > 0).all()).then(
                col("bound_m3").mean()
            ),
            years=pl.len(), seeds=col("seeds").min(), runs=col("seeds").sum(),
            worst_year=col("year").sort_by(TOTAL).last(), worst_year_m3=col(TOTAL).max(),
        )
        names = table.with_columns(
            all_years=col("year").n_unique().over("place"),
            all_seeds=col("seed").n_unique().over("place", "forecast", "skill"),
        ).group_by("case", maintain_order=True).agg(
            col(
                "run", "kind", "window", "place", *_FACTS[SINGLE], "from", "controller", "label",
                "setting", "rank", "skill", "skill rank", "ended", "hours", "roof_m2",
                "cistern_size_m3", "all_years", "all_seeds",
            ).first(),
            totals=col(TOTAL), worst_m3=col(TOTAL).max(),
        )
        worst = [
            self._deviations[case].worst_weeks() if kind == SEASONS
            else worst_tenth(np.array(totals))
            for case, kind, totals in names.select("case", "kind", "totals").iter_rows()
        ]
        return names.with_columns(worst_tenth_m3=pl.Series(worst, dtype=pl.Float64)).join(
            means, on="case", maintain_order="left"
        ).with_columns(
            ratio=col(TOTAL) / col("bound_m3"),
            missing=col("all_years") * col("all_seeds") - col("runs"),
        ).sort("place", "rank", "skill rank", "case")

    @cached_property
    def _deviations(self) -> dict[int, Deviations]:
        """Deviations of each case that is a season of several years."""
        deviations: dict[int, Deviations] = {}
        seasons = self.table.filter(kind=SEASONS).sort(
            "year", pl.col("seed").str.len_chars(), "seed"
        )
        for (case, year), runs in seasons.group_by("case", "year", maintain_order=True):
            of = deviations.setdefault(case, Deviations())
            of.totals[year] = runs[TOTAL].to_numpy()
            of.weeks[year] = np.array(runs["season"].to_list())
        return deviations

    # --- windows and headings --------------------------------------------------------------------

    def of(self, kind: str) -> list[Row]:
        """Return the cases of a kind."""
        return self.cases.filter(kind=kind).to_dicts()

    @cached_property
    def single(self) -> list[Row]:
        """The runs that are cases of their own, in the given order."""
        return self.table.filter(kind=SINGLE).to_dicts()

    def windows(self, kind: str = SINGLE) -> list[Row]:
        """Return the first run of each window of a kind."""
        return self.table.filter(kind=kind).group_by("window", maintain_order=True).first(
        ).to_dicts()

    def differing_facts(self, kind: str = SINGLE) -> list[str]:
        """Return the facts that differ between windows, for use as columns and in titles."""
        return differing([facts(row) for row in self.windows(kind)])

    @cached_property
    def initials(self) -> list[str]:
        """Names of the initial states of the runs that are cases of their own."""
        return list(dict.fromkeys(row["from"] for row in self.single))

    def heading(self, row: Row, names: Sequence[str] = ()) -> str:
        """Name the window of a run; with ``names``, by these facts only."""
        return heading(row, self.differing_facts(row["kind"]), names)

    def title(self, text: str, row: Row) -> str:
        """Return a figure's title, with the window if there are several."""
        return f"{text}: {self.heading(row)}" if len(self.windows()) > 1 else text

    def best(self) -> list[Row]:
        """Return the run of each controller with the smallest deviation, place by place.

        Only single runs count. If all of them are equal, there is no setting.
        """
        def order(row: Row) -> tuple[int, ...]:
            return row["window"], self.initials.index(row["from"]), row["rank"] // _SETTINGS

        best = []
        for _, group in groupby(sorted(self.of(SINGLE), key=order), key=order):
            first, *others = sorted(group, key=lambda row: (row[TOTAL], row["case"]))
            alike = others and first[TOTAL] == others[-1][TOTAL]
            best.append({**first, "setting": ""} if alike else first)
        return best

    # --- seasons of several years ----------------------------------------------------------------

    @cached_property
    def sizing(self) -> bool:
        """Whether the seasons are of several sites that differ only in size."""
        sites = [asdict(self.runs[row["run"]].site) for row in self.of(SEASONS)]
        sizes = {(site["a2"], site["a1"] * site["z_o"]) for site in sites}
        return len(sizes) > 1 and set(differing(sites)) <= _BY_SIZE

    @cached_property
    def with_forecast_errors(self) -> set[str]:
        """The controllers that ran seasons with imperfect forecasts.

        Other controllers, such as on/off, may use no forecast: they are shown with any of these.
        """
        return {row["controller"] for row in self.of(SEASONS) if row["forecast"] != PERFECT}

    @cached_property
    def plain_onoff(self) -> list[Row]:
        """Of each place, the on/off controller that fills to the target, as in the paper.

        Of several with different shares of the flow, it has the smallest mean deviation:
        with ticks of some seconds, full flow overshoots the target, which no site would accept.
        """
        (level,) = (known.default for known in OnOff.parameters if known.name == "level")
        return lowest(
            row for row in self.of(SEASONS) if row["controller"] == "onoff"
            and self.runs[row["run"]].parameters.get("level", level) == level
        )

    @cached_property
    def smallest(self) -> list[Row]:
        """Of each place, the cases with the smallest mean deviation that is possible on a site.

        Controllers with perfect forecasts do not count, unless no forecasts here have errors, nor
        do cases that lack years or seeds.
        """
        complete = (row for row in self.of(SEASONS) if not row["missing"])
        return lowest(
            row for row in complete if not self.with_forecast_errors or row["forecast"] != PERFECT
            or not (row["controller"] in self.with_forecast_errors
                    or "horizon" in self.runs[row["run"]].parameters)
        )

    @cached_property
    def relative_to_onoff(self) -> list[Row]:
        """The seasons' cases compared with plain on/off.

        ``has`` is the :class:`.intervals.Comparison`, ``than`` the row of plain on/off.
        """
        return self._relative_to(self.plain_onoff)

    @cached_property
    def relative_to_best(self) -> list[Row]:
        """The same compared with the case of smallest deviation, if that is not plain on/off."""
        plain = [row["case"] for row in self.plain_onoff]
        known = {row["place"] for row in self.smallest if row["case"] in plain}
        return self._relative_to([row for row in self.smallest if row["place"] not in known])

    def _relative_to(self, references: Sequence[Row]) -> list[Row]:
        others, compared = {row["place"]: row for row in reversed(references)}, []
        for row in self.of(SEASONS):
            than = others.get(row["place"], row)
            has = compare(self._deviations[row["case"]], self._deviations[than["case"]])
            if than["case"] != row["case"] and has is not None:
                compared.append({**row, "than": than, "has": has})
        return compared

    def years(self, row: Row) -> list[tuple[int, np.ndarray[Any, Any]]]:
        """Return each year of a season's case, and the total deviation of each seed in it (m3)."""
        return list(self._deviations[row["case"]].totals.items())


def who(row: Row) -> str:
    """Name the controller of a case, with its setting if it has one."""
    return f"{controller_name(row['controller'])} {row['setting']}".strip()


def unique(rows: Sequence[Row], names: Sequence[str]) -> list[str]:
    """Return names of runs; a name that several runs have is followed by the run's own."""
    return [
        f"{name} ({row['run']})" if names.count(name) > 1 else name
        for row, name in zip(rows, names, strict=True)
    ]


def facts(row: Row) -> Row:
    """Return the facts that a run shares with the runs that it is compared with."""
    return {name: row[name] for name in _FACTS[row["kind"]]}


def by_place(rows: Iterable[Row]) -> list[list[Row]]:
    """Return the cases of each place, which must be adjacent."""
    return [list(group) for _, group in groupby(rows, key=lambda row: row["place"])]


def lowest(rows: Iterable[Row]) -> list[Row]:
    """Return from each place the case with the smallest total deviation, or several that are equal.

    Cases that lack years or seeds come after all others: they may lack the worst.
    """
    found: list[Row] = []
    for here in by_place(rows):
        order = [(row["missing"], row[TOTAL]) for row in here]
        found += [row for row, key in zip(here, order, strict=True) if key == min(order)]
    return found


def _kinds(rows: Sequence[Row]) -> list[str]:
    """Return the kind of each run: single, one of many seeds, or of a season of several years."""
    season = pl.col("season").is_not_null() & (pl.col("year").n_unique().over(
        "site", "evapotranspiration", "begins", "hours", "sensor and pump errors", "from",
        pl.col("season").is_not_null(),
    ) > 1)
    of_season = pl.when(season).then(pl.lit(SEASONS))
    table = pl.DataFrame(rows, schema=_SCHEMA).with_columns(kind=of_season)
    # All initial states of a window are of one kind.
    seeds = (pl.col("seed") != "") & (pl.col("seed").n_unique().over(
        "site", "weather", "start", "hours", "evapotranspiration", "model",
        "sensor and pump errors", "skill", "kind",
    ) > 1)
    alone = pl.when(seeds).then(pl.lit(SEEDS)).otherwise(pl.lit(SINGLE))
    return table.select(pl.col("kind").fill_null(alone))["kind"].to_list()


def _derived(assumptions: Assumptions) -> list[pl.Expr]:
    """Return what is derived from the results: changes of storage, mass balance errors and money.

    The mass balance error, the change of storage that the flows do not explain, is rounding in a
    simulation. On a site it is all that was not measured.
    """
    col = pl.col
    cistern = col("final_cistern_m3") - col("cistern_m3")
    layer = (col("final_layer_m3") - col("initial_layer")).fill_null(0)
    roof = col("final_roof_m3") - col("roof_m3") + layer
    into_cistern = (
        col("rain_cistern_m3") - col("pumped_m3") - col("outflow_m3") + col("mains_m3").fill_null(0)
    )
    into_roof = (
        col("rain_roof_m3") + col("pumped_m3") - col("evapotranspiration_m3") - col("drainage_m3")
    )
    return [
        cistern.alias("cistern_change_m3"),
        roof.alias("roof_change_m3"),
        (cistern - into_cistern).alias("cistern_residual_m3"),
        (roof - into_roof).alias("roof_residual_m3"),
        (col("electric_energy_kwh") * assumptions.energy_price).alias("energy_cost"),
        (col("pumped_m3") * assumptions.water_price).alias("water_value"),
        (col(TOTAL) / pl.when(col("bound_m3") > 0).then("bound_m3")).alias("ratio"),
        # The last sample is treated as one tick.
        (col("near_target_hours") / (col("hours") + col("tau") / 3600)).alias("near_share"),
    ]
