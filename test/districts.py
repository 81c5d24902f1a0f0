"""Small districts for the tests."""

from __future__ import annotations

from pathlib import Path

from places import DATA

WEATHER = DATA / "en_climate_hourly_07-2021.csv"
# Two storms, with 23 mm and 13 mm within hours; dry days before, between and after them.
DISTRICT = f"""
site: site_valve.yaml
buildings: 8
draw:
  catchment_area: {{mean: 200, sd: 120, low: 60, high: 1000}}
  cistern_volume: {{mean: 3, sd: 2, low: 1.0, high: 6.0}}
  substrate_depth: {{values: [0.08, 0.108]}}
weather: {{file: {WEATHER}, season: 07-07/07-09}}
draws: 1
forecast: perfect
adoption: [0.25, 0.5, 1.0]
sewer_capacity: 2.0
"""


def write_district(directory: Path, text: str = DISTRICT) -> Path:
    """Write a district's file."""
    file = directory / "district.yaml"
    file.write_text(text, encoding="utf-8")
    return file


def edit(old: str, new: str) -> str:
    """Return the district with a replaced part."""
    assert old in DISTRICT
    return DISTRICT.replace(old, new)
