"""The tool that compares the model with two measured roofs: its reading, and its peaks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import percolation as tool
import pytest
from twins import TWIN


def test_tables_with_clocks_of_their_own(tmp_path: Path) -> None:
    """Two days of rain on the minute, and of runoff some seconds later, with a gap.

    Both days are the same, so they have the same evapotranspiration.
    """
    rain, runoff, temperature = (tmp_path / name for name in ("rain", "runoff", "temperature"))
    days = np.datetime64("2019-05-01T00:00") + 5 * np.arange(576) * np.timedelta64(1, "m")
    rain.write_text("dateTime;rain\n" + "".join(
        f"{str(time).replace('T', ' ')}:00;{0.1 * (step % 4)}\n" for step, time in enumerate(days)
    ))
    runoff.write_text("time,runoff [mm/5min]\n" + "".join(
        f"{str(time).replace('T', ' ')}:16,{step / 100}\n" for step, time in enumerate(days)
        if step != 7
    ))
    temperature.write_text("TEGEL\t2019 05 01\t20\t8\nTEGEL\t2019 05 02\t20\t8\n")
    site = replace(TWIN, latitude=52.5, longitude=13.4)
    record = tool.read_roof([rain, runoff, temperature], site)
    assert record.rain.tolist() == pytest.approx(np.tile([0.0, 0.1, 0.2, 0.3], 144).tolist())
    assert np.flatnonzero(np.isnan(record.measured["runoff"])).tolist() == [7]
    assert record.measured["runoff"][8:] == pytest.approx(np.arange(8, 576) / 100)
    first, second = record.reference[:288].sum(), record.reference[288:].sum()
    assert second == pytest.approx(first, rel=0.02) and 2 < first < 5


def test_peaks_by_hand() -> None:
    """Of storms of 1, 2 and 6 mm in a row, and of 4 mm: 6 and 4 mm in 5 min, 9 and 4 in 15 min."""
    runoff = np.array([0.0, 1.0, 2.0, 6.0, 0.0, 0.0, 0.0, 4.0, 0.0])
    storms = [slice(0, 5), slice(5, 9)]
    assert tool.find_peaks(runoff, storms, 1).tolist() == [72.0, 48.0]
    assert tool.find_peaks(runoff, storms, 3).tolist() == [36.0, 16.0]
