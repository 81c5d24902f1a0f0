"""Names of a study's cases, which state only what differs, in the words of the keys."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from greenroof_ros.analysis.case import Case
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.forecast.choice import OPTIONS
from greenroof_ros.physics.sensor_and_pump import PARAMETERS
from greenroof_ros.results.table import format_exactly
from greenroof_ros.site.file import DETERMINES, SITE_KEYS
from greenroof_ros.weather.records import name_files

# The words for the valve's policy, and for the parameters of a site that a plain key sets alone.
_WORDS = {"outlet": "valve"} | {own: key for key, (own, *more) in DETERMINES.items() if not more}


def name_cases(cases: Sequence[Case]) -> list[dict[str, str]]:
    """Return the columns that name the runs of a study, and group them.

    Runs with the same ``window`` and initial state are compared. Among these, runs with the same
    ``case`` differ only in their seeds and, if ``season`` is not empty, in the year. ``site`` is
    the name of a file in the study.
    """
    sites = tell_apart([_describe_site(case) for case in cases])
    seasons, of_season = list[dict[str, str]](), dict[str, set[int]]()
    for case, site in zip(cases, sites, strict=True):
        start, hours = datetime.fromisoformat(case.inputs.start), case.hours
        seasons.append({
            "site": site, "weather": name_files(case.inputs.weather),
            "start": f"from {start:%d %B %H:%M}",
            "hours": f"to {start + timedelta(hours=hours):%d %B %H:%M}",
            "evapotranspiration": f"{case.inputs.evapotranspiration} evapotranspiration",
            "gaps": f"gaps {case.inputs.gaps}",
            "climate": str(case.inputs.climate) or "climate of the record",
        })
        of_season.setdefault(str(seasons[-1]), set()).add(start.year)
    facts = [
        season if len(of_season[str(season)]) > 1 else season | {
            "start": f"from {case.inputs.start}", "hours": f"{format_exactly(case.hours)} h",
        } for case, season in zip(cases, seasons, strict=True)
    ]
    windows = tell_apart(facts)
    settings = dict[int, str]()
    for window in {*windows}:
        places = [place for place, other in enumerate(windows) if other == window]
        names = tell_apart([_describe_setting(cases[place]) for place in places])
        settings |= zip(places, names, strict=True)
    return [
        {
            "window": windows[place] or f"{facts[place]['start']}, {facts[place]['hours']}",
            "case": settings[place] or case.inputs.controller.name,
            "season": facts[place]["start"] if facts[place] is seasons[place] else "",
            "site": re.sub(r"[^-+.\w]+", "_", sites[place] or Path(case.site_file).stem) + ".yaml",
        } for place, case in enumerate(cases)
    ]


def tell_apart(facts: Sequence[Mapping[str, str]]) -> list[str]:
    """Return a name for each mapping: the fewest of its texts that tell it from the others.

    Earlier keys are preferred. Equal mappings have the same name, and a single one has none.
    """
    names, groups = [list[str]() for _ in facts], [list(range(len(facts)))]
    for key in dict.fromkeys(key for each in facts for key in each):
        finer: dict[tuple[int, str], list[int]] = {}
        for number, group in enumerate(groups):
            for index in group:
                finer.setdefault((number, facts[index].get(key, "")), []).append(index)
        for (number, text), members in finer.items():
            if len(members) < len(groups[number]) and text:
                for index in members:
                    names[index].append(text)
        groups = [*finer.values()]
    return [", ".join(name) for name in names]


def _describe_site(case: Case) -> dict[str, str]:
    volume = case.site.cistern_volume(case.site.z_o)
    return {
        "file": Path(case.site_file).stem, "cistern": f"cistern {format_exactly(volume)} m3",
        **_describe(asdict(case.site), SITE_KEYS),
    }


def _describe_setting(case: Case) -> dict[str, str]:
    """Return what differs between the runs of a window, without seeds and what has no effect."""
    inputs, forecast = case.inputs, case.inputs.forecast
    return {
        "controller": inputs.controller.name,
        **dict.fromkeys(inputs.controller.parameters, ""),  # in this order
        **_describe(inputs.parameters, inputs.controller.parameters),
        "forecast": f"forecast {forecast}", **_describe(forecast.options(), OPTIONS),
        **_describe(inputs.sensor_and_pump.values(), PARAMETERS),
    }


def _describe(values: Mapping[str, Any], known: Mapping[str, Parameter]) -> dict[str, str]:
    """Return the words, the value and the unit of each key, without seeds."""
    texts = {
        name: format_exactly(value) if isinstance(value, (int, float)) else str(value)
        for name, value in values.items() if value is not None and not name.endswith("seed")
    }
    return {
        name: " ".join(filter(None, [
            _WORDS.get(name, name).replace("_", " "), text,
            "" if (unit := known[name].unit) == "1" else unit,
        ])) for name, text in texts.items()
    }
