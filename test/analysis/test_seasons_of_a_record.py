"""Seasons: which days, which years, and which are incomplete."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from places import CONFIG

from greenroof_ros.analysis.seasons import find_seasons, read_window
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site

SITE = read_site(CONFIG / "site_valve.yaml", {"tau": 60.0, "M": 1})


def frame(first: str, last: str, missing: tuple[str, str] | None = None) -> pd.DataFrame:
    """Return hourly weather without rain, in local standard time."""
    times = pd.date_range(first, last, freq="h", tz=timezone(timedelta(hours=-5)))
    table = pd.DataFrame({
        "precipitation [mm/h]": 0.0, "evapotranspiration [mm/day]": 3.0,
    }, index=times)
    if missing is not None:
        table.loc[missing[0]:missing[1], "precipitation [mm/h]"] = float("nan")
    return table


def seasons(
    table: pd.DataFrame, window: str | None, site: Site = SITE, **options: Any
) -> tuple[dict[str, Run], dict[str, str]]:
    """Return complete and incomplete seasons."""
    inputs = make_inputs(find_controller("onoff"), {"site": site, "weather": table, **options})
    weather, _ = inputs.read_records(site)
    return find_seasons(inputs, site, weather, read_window(window, site))


def test_default_window_is_the_local_summer() -> None:
    """May to October in the north, November to April in the south."""
    assert str(read_window(None, SITE)) == "1 May to 31 October"
    south = read_site(CONFIG / "site_valve.yaml", {"latitude": -33.9})
    window = read_window(None, south)
    assert str(window) == "1 November to 30 April"
    assert (window.days, window.name(2015)) == (181, "2015/16")


@pytest.mark.parametrize("text", ["", "5-1/10-31", "05-01/10-32", "02-29/10-31", 5])
def test_wrong_windows(text: Any) -> None:
    """The message shows the form."""
    with pytest.raises(ConfigurationError, match=r"season = .*such as 05-01/10-31"):
        read_window(text, SITE)


def test_complete_seasons_and_others() -> None:
    """Of 2019 the beginning is missing, of 2020 an hour of rain, of 2022 the end."""
    table = frame("2019-05-10", "2022-05-30T23:00", ("2020-05-12T03:00", "2020-05-12T14:00"))
    runs, incomplete = seasons(table, "05-01/05-31")
    assert list(runs) == ["2021"]
    assert runs["2021"].start == datetime(2021, 5, 1, tzinfo=timezone(timedelta(hours=-5)))
    assert runs["2021"].steps == 31 * 24 * 60
    assert list(incomplete) == ["2019", "2020", "2022"]
    record = "the record is from 2019-05-10T00:00-05:00 to 2022-05-31T00:00-05:00"
    assert incomplete["2019"] == incomplete["2022"] == record
    assert "precipitation is missing at 2020-05-12T03:00" in incomplete["2020"]
    runs, incomplete = seasons(table, "05-01/05-31", gaps="fill")
    assert list(runs) == ["2020", "2021"] and list(incomplete) == ["2019", "2022"]


def test_a_season_across_the_turn_of_the_year() -> None:
    """It has the name of both years; all seasons are equally long, also with a 29 February."""
    runs, incomplete = seasons(frame("2019-12-01", "2021-03-01T00:00"), "12-01/02-28")
    assert list(runs) == ["2019/20", "2020/21"] and not incomplete
    assert {run.steps for run in runs.values()} == {90 * 24 * 60}


def test_a_season_that_begins_while_the_clocks_are_put_forward() -> None:
    """In Cuba, 14 March 2021 began at 01:00; 2020 and 2022 had other days."""
    cuba = read_site(CONFIG / "site_valve.yaml", {
        "tau": 60.0, "M": 1, "time_zone": "America/Havana", "utc_offset": -5.0,
    })
    runs, incomplete = seasons(frame("2020-01-01", "2022-12-31"), "03-14/03-20", cuba)
    assert (list(runs), incomplete) == (["2020", "2021", "2022"], {})


def test_a_record_that_is_too_short(tmp_path: Path) -> None:
    """The message says what there is, and what would help."""
    with pytest.raises(ConfigurationError, match=r"a complete season, 1 May to 31 October.*from "
                       r"2021-05-01.*Choose other days with season"):
        seasons(frame("2021-05-01", "2021-05-31T23:00"), None)
