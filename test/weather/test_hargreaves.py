"""Hargreaves' equation and the sun, compared with FAO-56's worked examples."""

from __future__ import annotations

import numpy as np
import pytest
from places import CONFIG, DATA

from greenroof_ros.model.site import read_site
from greenroof_ros.weather.evapotranspiration import (
    evaporable,
    extraterrestrial_radiation,
    hargreaves,
    over_the_day,
    sun_height,
)
from greenroof_ros.weather.reading import read_weather


def days(*texts: str) -> np.ndarray:
    return np.array(texts, dtype="datetime64[D]")


def test_worked_examples() -> None:
    """Example 8: Ra on 3 September at 20 degrees south, 32.2 MJ/m2 and day, evaporates 13.1 mm.

    Example 9: the sun is up for 11.7 h then. Example 20: Lyon in July, 14.8 to 26.6 degC, has
    5.0 mm/day by Eq. 52, with the Ra of 15 July, 40.6. Hard frost has none.
    """
    radiation = extraterrestrial_radiation(-20.0, days("1998-09-03"))
    assert radiation == pytest.approx([32.2], abs=0.05)
    assert evaporable(radiation) == pytest.approx([13.1], abs=0.05)
    seconds = (np.datetime64("1998-09-03", "s") + 60 * np.arange(1440)).astype(np.int64)
    assert (sun_height(-20.0, seconds, 0.0) > 0).sum() / 60 == pytest.approx(11.7, abs=0.05)
    lyon, july = 45 + 43 / 60, days("1998-07-15")
    assert extraterrestrial_radiation(lyon, july) == pytest.approx([40.6], abs=0.05)
    assert hargreaves(lyon, july, np.array([14.8]), np.array([26.6])) == pytest.approx(
        [5.0], abs=0.05
    )
    assert hargreaves(52.5, days("2019-01-20"), np.array([-30.0]), np.array([-20.0])) == [0.0]


def test_the_sun_stands_highest_at_noon_of_its_own_meridian() -> None:
    """7.5 degrees west of the clock's meridian this is half an hour later.

    On 15 April and 1 September the equation of time is 0 within a minute (Eq. 32).
    """
    seconds = (np.datetime64("1998-04-15", "s") + 60 * np.arange(1440)).astype(np.int64)
    highest = int(np.argmax(sun_height(45.0, seconds, -7.5)))
    assert highest == pytest.approx(12 * 60 + 30, abs=2)


def test_whole_days_keep_their_sum_and_parts_theirs() -> None:
    first = np.datetime64("2015-06-01T12:00", "s").astype(np.int64)
    seconds = first + 300 * np.arange(288 * 2 + 144)
    day = (seconds // 86400 - first // 86400).astype(np.int64)
    steps = over_the_day(np.array([4.0, 5.0, 6.0]), 52.5, seconds, day, 300.0, 0.0)
    sums = np.bincount(day, steps)
    assert sums[1:] == pytest.approx([5.0, 6.0], rel=1e-3)
    assert sums[0] == pytest.approx(2.0, abs=0.1)  # from noon on, half of the day's
    assert steps[(seconds % 86400) < 3 * 3600].tolist() == [0.0] * 72


def test_longer_and_shorter_steps_have_the_sums_of_five_minutes() -> None:
    first = np.datetime64("2015-06-01", "s").astype(np.int64)
    daily = np.array([4.0, 5.0, 6.0])

    def over(step_s: int) -> np.ndarray:
        seconds = first + step_s * np.arange(3 * 86400 // step_s)
        day = seconds // 86400 - first // 86400
        return over_the_day(daily, 52.5, seconds, day, float(step_s), -1.5)

    quarters = over(300).reshape(-1, 12 * 6).sum(axis=1)
    assert over(3600 * 6) == pytest.approx(quarters)
    assert over(60).reshape(-1, 60 * 6).sum(axis=1) == pytest.approx(quarters, rel=1e-3)


def test_july_in_toronto_by_both_methods() -> None:
    """A crop coefficient fitted with Hargreaves' equation is also good with ``fao56`` there.

    The sums over July 2021 differ by less than 1 %.
    """
    site = read_site(CONFIG / "site.yaml")
    weather = read_weather([DATA / "en_climate_hourly_07-2021.csv"], site, "fao56")
    temperature = weather.values["temperature"].reshape(31, 24)
    july = np.arange("2021-07-01", "2021-08-01", dtype="datetime64[D]")
    assert site.latitude is not None
    depth = hargreaves(site.latitude, july, temperature.min(axis=1), temperature.max(axis=1))
    assert depth.sum() == pytest.approx(weather.evapotranspiration.reshape(31, 24).mean(1).sum(),
                                        rel=0.01)
