"""Weather of another climate, against a record that was changed by hand."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from places import CONFIG

import greenroof_ros as gr
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.site.file import read_site
from greenroof_ros.weather.climate import Climate
from greenroof_ros.weather.read import read_weather

RECORD = CONFIG / "weather" / "toronto_2021-07.csv"
SITE = read_site(CONFIG / "site.yaml")


def write_warmer(file: Path, warming: float, factor: float) -> None:
    """Write the record with more rain, and warmer at the same relative humidity.

    The ratio of the vapour pressure to that of saturation, FAO-56 Eq. 11, is kept by bisection.
    """
    def pressure(temperature: float) -> float:
        return 0.6108 * math.exp(17.27 * temperature / (temperature + 237.3))

    comments, lines = [], []
    for line in RECORD.read_text().splitlines():
        (comments if line.startswith("#") else lines).append(line)
    table = list(csv.DictReader(lines))
    for row in table:
        name = {key.partition(" [")[0]: key for key in row}
        temperature, dew = float(row[name["temperature"]]), float(row[name["dew point"]])
        wanted = pressure(dew) / pressure(temperature) * pressure(temperature + warming)
        low, high = -50.0, 60.0
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if pressure(middle) < wanted else (low, middle)
        row[name["temperature"]] = repr(temperature + warming)
        row[name["dew point"]] = repr(low)
        row[name["precipitation"]] = repr(factor * float(row[name["precipitation"]]))
    with file.open("w", newline="") as stream:
        stream.writelines(f"{comment}\n" for comment in comments)
        writer = csv.DictWriter(stream, [*table[0]])
        writer.writeheader()
        writer.writerows(table)


def test_rain_and_temperature_at_the_same_humidity(tmp_path: Path) -> None:
    write_warmer(tmp_path / "warmer.csv", 2.5, 1.2)
    expected = read_weather([tmp_path / "warmer.csv"], SITE, "fao56")
    found = read_weather([RECORD], SITE, "fao56", climate=Climate(1.2, 2.5))
    for name, values in expected.values.items():
        np.testing.assert_allclose(found.values[name], values, rtol=1e-9, err_msg=name)
    plain = read_weather([RECORD], SITE, "fao56")
    assert np.nansum(found.evapotranspiration) > np.nansum(plain.evapotranspiration)


def test_rain_of_minutes(tmp_path: Path) -> None:
    """Rows of five minutes are multiplied, too."""
    files = [tmp_path / "gauge.csv"]
    rows = (f"2021-07-07T{row // 12:02}:{row % 12 * 5:02}Z,{row % 7}" for row in range(48))
    files[0].write_text("\n".join(["time,precipitation [mm/h]", *rows, ""]))
    plain, wetter = (
        read_weather(files, SITE, "", climate=Climate(factor)) for factor in (1.0, 1.5)
    )
    np.testing.assert_array_equal(wetter.finest_rain, 1.5 * plain.finest_rain)


def test_runs_in_another_climate() -> None:
    """An unchanged climate is the record bit for bit; a change that does nothing is noted."""
    given = {"hours": 6, "start": "2021-07-07T14:00"}
    plain, same, wetter = (
        gr.simulate("onoff", **given, **more) for more in (
            {}, {"rain_factor": 1.0, "temperature_change": 0.0}, {"rain_factor": 2.0},
        )
    )
    assert plain.metrics == same.metrics
    assert wetter.metrics["rain_m3"] == pytest.approx(2 * plain.metrics["rain_m3"])
    with pytest.warns(UserWarning, match=r"changes only the frost: published"):
        gr.simulate("onoff", **given, temperature_change=2.0)


def test_a_study_of_climates() -> None:
    """Its windows are named by what differs, and its figures are those of runs."""
    given = {"start": "2021-07-07T14:00", "hours": 6.0, "evapotranspiration": "published"}
    table = gr.study({"controller": ["onoff"], "rain_factor": [1.0, 1.5], **given})
    assert table["window"].to_list() == ["climate of the record", "rain times 1.5"]
    alone = gr.simulate("onoff", **given, rain_factor=1.5)
    assert table["rain_m3"][1] == alone.metrics["rain_m3"]


def test_archived_forecasts_do_not_know_another_climate() -> None:
    with pytest.raises(ConfigurationError, match="cannot be combined with another climate"):
        gr.Environment(**{**gr.scenarios["season-forecasts"].inputs, "rain_factor": 1.2})
