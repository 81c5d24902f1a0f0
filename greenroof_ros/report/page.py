"""The page of a report: one file that needs nothing but a browser."""

from __future__ import annotations

import importlib.resources
import inspect
import json
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import vl_convert
from markupsafe import Markup

from greenroof_ros.common.versions import versions
from greenroof_ros.forecast.choice import PERFECT
from greenroof_ros.model.site import Site
from greenroof_ros.report.assessment import Assumptions
from greenroof_ros.report.drawing import CONFIG, Figure, Rows
from greenroof_ros.report.results import Report, Result, best_runs, controller_name
from greenroof_ros.report.runs import RunEntry, Sources
from greenroof_ros.report.seeds import Spread, spreads


class Cell(NamedTuple):
    """A cell of a table: what is shown, and what the table is sorted by."""

    text: str
    key: float | str
    warning: bool = False


class Table(NamedTuple):
    """A table that a reader can sort; the first column names the row."""

    name: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]


def render(
    report: Report, figures: Sequence[Figure], sources: Sources, assumptions: Assumptions
) -> str:
    """Return the page.

    Args:
        report: the results.
        figures: in the order in which they appear.
        sources: where the results are from.
        assumptions: what the assessments rest on.
    """
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    text = importlib.resources.files(__package__).joinpath("template.html").read_text("utf-8")
    panels = [
        {
            "id": f"{figure.name}-panel-{number}",
            "figure": figure.name,
            "specification": panel.specification(),
            "data": _names(panel.specification()),
        }
        for figure in figures
        for number, panel in enumerate(figure.panels, start=1)
    ]
    data = {name: _columns(rows) for figure in figures for name, rows in figure.data.items()}
    payload = json.dumps(
        {"config": CONFIG, "panels": panels, "data": data},
        allow_nan=False, separators=(",", ":"), ensure_ascii=False,
    )
    library: str = vl_convert.javascript_bundle()  # type: ignore[call-arg]  # its stub is stricter
    return environment.from_string(text).render(
        report=report,
        figures=figures,
        controllers=[controller_name(name) for name in report.controllers],
        failed=sources.failed,
        tables=[
            *_seeded(report),
            *([_best_table(report)] if report.results else []),
            *_methods(report),
            *(_tables(report, assumptions) if report.results else []),
        ],
        notes=_notes(report),
        bounds=any(one.bound_m3 for one in report.results)
        or any(one.bound_m3 for one in spreads(report)),
        assumptions=assumptions,
        windows=[*map(str, report.windows), *_seeded_windows(report)],
        sites=_sites(report),
        configuration=sources.configuration,
        versions=_versions(),
        # Scripts and JSON are not HTML: they are made safe here, each in its own way.
        library=Markup(library.replace("</script", "<\\/script")),  # noqa: S704
        payload=Markup(payload.replace("<", "\\u003c")),  # noqa: S704
    )


def _names(specification: dict[str, Any]) -> list[str]:
    """Return the names of the data that a specification refers to and does not hold."""
    own = specification.get("datasets", {})
    layers = (specification, *specification.get("layer", []))
    found = [layer["data"].get("name") for layer in layers if "data" in layer]
    return list(dict.fromkeys(name for name in found if name and name not in own))


def _columns(rows: Rows) -> dict[str, list[Any]]:
    """Return rows as columns, in which each name stands once."""
    return {name: [row[name] for row in rows] for name in (rows[0] if rows else {})}


# --- tables ------------------------------------------------------------------------------------


def _number(value: float, digits: str = ".4g", warning: bool = False) -> Cell:
    text = f"{value:{digits}}"
    return Cell("0" if float(text) == 0 else text, value, warning)


def _word(text: str) -> Cell:
    return Cell(text, text)


class _Column(NamedTuple):
    """A column of the results."""

    header: str
    cell: Callable[[Result], Cell]


def _named(report: Report) -> list[_Column]:
    """Return the columns that say which run it is; none that is the same for all."""
    order = {
        (name, label): place
        for name in report.controllers
        for place, label in enumerate(report.settings[name].labels)
    }

    def setting(one: Result) -> Cell:
        name = one.entry.controller
        label = report.settings[name].label(one.entry)
        return Cell(
            report.settings[name].full_label(one.entry), f"{name} {order[name, label]:06}"
        )

    columns = [_Column("run", lambda one: _word(one.entry.name))]
    if len({one.entry.site_name for one in report.results}) > 1:
        columns.append(_Column("site", lambda one: _word(one.entry.site_name)))
    if len({window[1:4] for window in report.windows}) > 1:
        columns.append(
            _Column(
                "weather",
                lambda one: Cell(
                    f"{one.start.isoformat(' ', 'minutes')}, {one.assessment.hours:.4g} h",
                    one.start.timestamp(),
                ),
            )
        )
    if len({window.method for window in report.windows}) > 1:
        columns.append(_Column("evapotranspiration", lambda one: _word(one.entry.method)))
    if len({window.forecast for window in report.windows}) > 1:
        columns.append(
            _Column("forecast", lambda one: _word(one.entry.forecast or PERFECT))
        )
    if len({window.sensor_pump_errors for window in report.windows}) > 1:
        columns.append(
            _Column("sensor_pump_errors", lambda one: _word(one.entry.sensor_pump_errors or "none"))
        )
    return [
        *columns,
        _Column("from", lambda one: _word(one.entry.initial)),
        _Column("controller", lambda one: _word(controller_name(one.entry.controller))),
        _Column("setting", setting),
    ]


def _tables(report: Report, assumptions: Assumptions) -> list[Table]:
    """Return what each run came to, and its water balance."""
    money = assumptions.currency
    performance = [
        _Column("total deviation (m³)", lambda one: _number(
            one.assessment.total_deviation_m3, ".2f")),
        *_ratio(report),
        _Column("near target (h)", lambda one: _number(one.assessment.band_hours, ".2f")),
        _Column("near target (%)", lambda one: _number(
            100 * one.assessment.band_hours / one.assessment.hours, ".1f")),
        _Column("potable water saved (m³)", lambda one: _number(one.assessment.pumped_m3)),
        _Column(f"value as mains water ({money})", lambda one: _number(one.assessment.water_value)),
        _Column("energy (Wh)", lambda one: _number(1000 * one.assessment.energy_kwh)),
        _Column(f"cost of energy ({money})", lambda one: _number(one.assessment.energy_cost)),
        _Column("pump starts", lambda one: _number(one.assessment.pump_starts, "d")),
        _Column("pump running (h)", lambda one: _number(one.assessment.pump_hours, ".3f")),
        _Column("largest command (1)", lambda one: _number(
            one.assessment.largest_command, ".6g", one.assessment.largest_command > 1)),
        _Column("beyond the pump (h)", lambda one: _number(
            one.assessment.beyond_hours, ".4f", one.assessment.beyond_hours > 0)),
        _Column("frost (h)", lambda one: _number(one.assessment.frost_hours, ".2f")),
        _Column("pumped in frost (m³)", lambda one: _number(
            one.assessment.frost_pumped_m3, ".4g", one.assessment.frost_pumped_m3 > 0)),
    ]
    balance = [
        _Column("cistern: rain (m³)", lambda one: _number(one.assessment.rain_cistern_m3)),
        _Column("pumped (m³)", lambda one: _number(one.assessment.pumped_m3)),
        _Column("to the sewer (m³)", lambda one: _number(one.assessment.outflow_m3)),
        _Column("change (m³)", lambda one: _number(one.assessment.cistern_change_m3)),
        _Column("unexplained (m³)", lambda one: _number(
            one.assessment.cistern_residual_m3, ".1e")),
        _Column("at the end (m³)", lambda one: _number(one.assessment.final_cistern_m3, ".6g")),
        _Column("roof: rain (m³)", lambda one: _number(one.assessment.rain_roof_m3)),
        _Column("evapotranspiration (m³)", lambda one: _number(
            one.assessment.evapotranspiration_m3)),
        _Column("drainage (m³)", lambda one: _number(one.assessment.drainage_m3)),
        _Column("change (m³)", lambda one: _number(one.assessment.roof_change_m3)),
        _Column("unexplained (m³)", lambda one: _number(one.assessment.roof_residual_m3, ".1e")),
        _Column("at the end (m³)", lambda one: _number(one.assessment.final_roof_m3, ".6g")),
    ]
    named = _named(report)
    return [
        Table(
            title,
            [column.header for column in (*named, *columns)],
            [[column.cell(one) for column in (*named, *columns)] for one in report.results],
        )
        for title, columns in (
            ("What each run came to", performance), ("Water balance of each run", balance)
        )
    ]


def _ratio(report: Report) -> list[_Column]:
    """Return the column of deviations over the least possible, where any is known."""
    if all(one.ratio_to_bound is None for one in report.results):
        return []
    return [_Column("over the least possible (1)", lambda one: _share(one.ratio_to_bound))]


def _share(value: float | None) -> Cell:
    """Return a cell of a ratio; the unknown ones come last."""
    return Cell("unknown", sys.float_info.max) if value is None else _number(value, ".4f")


def _best_table(report: Report) -> Table:
    """Return the best run of each controller."""
    rows = []
    ratio = _ratio(report)
    for window, initial, setting, run in best_runs(report):
        rows.append([
            _word(run.entry.name), _word(str(window)), _word(initial),
            _word(controller_name(run.entry.controller)),
            _word(setting),
            _number(run.assessment.total_deviation_m3, ".2f"),
            *(column.cell(run) for column in ratio),
            _number(run.assessment.pumped_m3),
            _number(run.assessment.largest_command, ".6g", run.assessment.largest_command > 1),
        ])
    header = ["run", "window", "from", "controller", "best setting", "total deviation (m³)",
              *(column.header for column in ratio), "potable water saved (m³)",
              "largest command (1)"]
    if len(report.windows) == 1:
        del header[1]
        for row in rows:
            del row[1]
    return Table("Least total deviation of each controller", header, rows)


def _seeded(report: Report) -> list[Table]:
    """Return what runs under forecast errors come to over their seeds, where there are many."""
    found = spreads(report)
    if not found:
        return []
    places = [one.place for one in found]
    # None that is the same for all.
    where = [
        (header, name)
        for header, name in (
            ("site", "site_name"), ("weather", "weather"), ("start", "start"),
            ("hours (h)", "hours"), ("evapotranspiration", "method"), ("forecast", "model"),
            ("sensor_pump_errors", "sensor_pump_errors"),
        )
        if len({getattr(place, name) for place in places}) > 1
    ]

    known = any(one.bound_m3 for one in found)

    def cell(value: float | str) -> Cell:
        return _word(value) if isinstance(value, str) else _number(value)

    def row(rank: int, one: Spread) -> list[Cell]:
        totals = (one.mean, one.worst_tenth, one.worst)
        return [
            _word(controller_name(one.controller)),
            Cell(one.setting, f"{one.controller} {rank:06}"),
            *(cell(getattr(one.place, name)) for _, name in where),
            _word(one.place.initial),
            _number(one.size),
            _number(len(one.totals), "d"),
            *(_number(total, ".2f") for total in totals),
            *(_share(total / one.bound_m3 if one.bound_m3 else None)
              for total in totals if known),
        ]

    amounts = ("mean", "worst tenth", "worst")
    return [Table(
        "Total deviation under forecast errors, over their seeds",
        ["controller", "setting", *(header for header, _ in where), "from", "size of the errors",
         "seeds", *(f"{amount} (m³)" for amount in amounts),
         *(f"{amount} over the least (1)" for amount in amounts if known)],
        [row(rank, one) for rank, one in enumerate(found)],
    )]


def _seeded_windows(report: Report) -> list[str]:
    """Name the windows of the seeded runs, each with its number of seeds."""
    seeds: dict[str, set[str]] = {}
    for entry in report.seeded:
        assert entry.seeded is not None
        of = entry.seeded
        seeds.setdefault(
            f"{Path(entry.weather).stem}, {of.start}, {of.hours:.4g} h, evapotranspiration "
            f"{entry.method}, forecast {of.model} size {of.size:g}"
            + (f", {entry.sensor_pump_errors}" if entry.sensor_pump_errors else ""), set(),
        ).add(of.seed)
    return [f"{window}, {len(found)} seeds" for window, found in seeds.items()]


def _methods(report: Report) -> list[Table]:
    """Return total deviations under both kinds of evapotranspiration, where there are both."""
    pairs = []
    for one in report.results:
        if one.entry.method != "published":
            continue
        window = one.window._replace(method="fao56")
        pairs += [
            (one, other)
            for other in report.of(window, one.entry.controller, one.entry.initial)
            if other.entry.parameters == one.entry.parameters
        ]
    if not pairs:
        return []
    rows = []
    for one, other in pairs:
        published, fao56 = (run.assessment.total_deviation_m3 for run in (one, other))
        share = 100 * (fao56 / published - 1) if published else 0.0
        rows.append([
            _word(report.label(one)), _word(one.entry.initial),
            _word(f"{one.start.isoformat(' ', 'minutes')}, {one.assessment.hours:.4g} h"),
            _number(published, ".2f"), _number(fao56, ".2f"), _number(share, "+.2f"),
        ])
    return [Table(
        "Total deviation under both kinds of evapotranspiration",
        ["setting", "from", "weather", "published (m³)", "fao56 (m³)", "difference (%)"], rows,
    )]


# --- words -------------------------------------------------------------------------------------


def _notes(report: Report) -> list[tuple[str, list[str]]]:
    """Return what a reader should know, each with the runs that it is about."""
    found: dict[str, list[str]] = {}

    def note(text: str, entry: RunEntry) -> None:
        found.setdefault(text, []).append(entry.name)

    for one in report.results:
        if one.assessment.beyond_hours > 0:
            note(
                "The command was above 1, which asks for more than the pumps have: no real pump "
                "can follow it.", one.entry,
            )
        if one.assessment.frost_hours > 0:
            pumped = one.assessment.frost_pumped_m3 > 0
            note("There was frost, and in it something was pumped." if pumped
                 else "There was frost; nothing was pumped in it.", one.entry)
        for text in one.notes:
            note(f"{text[0].upper()}{text[1:]}.", one.entry)
    for entry in report.seeded:
        note(
            "These runs differ only in the seed of their forecasts' errors from others. They are "
            "judged together, by results.csv: the tables of single runs, with energy, pump starts "
            "and water balance, and the figures of weather, trajectories and balances leave them "
            "out, and these notes say nothing of their commands and frost.", entry,
        )
        for text in entry.notes:
            # Of hundreds of runs each would have a note of its own.
            text = re.sub(r" in [\d.e+]+ ticks", " in some ticks", text)
            note(f"{text[0].upper()}{text[1:]}.", entry)
    return list(found.items())


def _sites(report: Report) -> list[tuple[str, list[tuple[str, str, str]]]]:
    """Return each site's parameters: symbol, value, and what it is with its unit."""
    meaning = dict(
        re.findall(r"^    (\w+): (.+(?:\n {8}.+)*)", inspect.getdoc(Site) or "", re.MULTILINE)
    )
    sites = {entry.site_name: entry.site for entry in report.entries}
    return [
        (
            name,
            [
                (key, str(value), " ".join(meaning.get(key, "").split()))
                for key, value in asdict(site).items() if value is not None
            ],
        )
        for name, site in sites.items()
    ]


def _versions() -> dict[str, str]:
    """Return the versions of what computed the numbers and drew the figures."""
    drawing = ("altair", "vl-convert-python", "rosbags", "polars")
    return {
        **versions(),
        **{name: metadata.version(name) for name in drawing},
        "vega": vl_convert.get_vega_version(),
    }
