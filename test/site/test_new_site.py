"""A new site, given by options; a run with it goes well."""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path

import pytest
from commands import run_command
from studies import WEATHER

from greenroof_ros.commands.new_site import format_new_site
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.physics.cistern import low_outlet_flow
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.site.file import SUBSTRATES, read_site
from greenroof_ros.site.site import Site

GIVEN = ("--roof", "120", "--catchment", "200", "--cistern", "5", "--place", "43.63,-79.40")
HOUSE = {
    "roof_area": 120.0, "catchment_area": 200.0, "cistern_volume": 5.0, "latitude": 43.63,
    "longitude": -79.4,
}


def new_site(directory: Path, *options: str) -> subprocess.CompletedProcess[str]:
    return run_command("new-site", *options, cwd=directory, env=dict(os.environ))


def made(path: Path, **given: object) -> Site:
    path.write_text(format_new_site({**HOUSE, **given}))
    return read_site(path)


def test_a_site_is_written_and_simulated(tmp_path: Path) -> None:
    """In a script, without a question: a site of minute ticks whose runs have nothing to note."""
    ended = new_site(tmp_path, *GIVEN)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.startswith("written: my_site.yaml, for a house at 43.63 N, 79.40 W\n")
    site = read_site(tmp_path / "my_site.yaml")
    assert (site.a1, site.z_o, site.a2, site.a_in, site.tau) == (2.5, 2.0, 120.0, 200.0, 60.0)
    # Neubrandenburg's stress begins at 35.1 mm; 0.96 * 4 mm more, rounded down to 0.1 mm.
    assert (site.z_veg, site.initial_cistern, site.initial_roof) == (0.0389, 2.5, 4.668)
    run = run_command(
        "simulate", "--site", "my_site.yaml", "--controller", "onoff", "--weather", str(WEATHER),
        "--hours", "72", "--start", "2021-07-07T00:00", "--pump-min-off", "1800", "--json",
        cwd=tmp_path, env=dict(os.environ),
    )
    assert run.returncode == 0, run.stderr
    summary = json.loads(run.stdout)
    assert [note for note in summary["notes"] if "look-ahead" not in note] == []
    assert summary["busiest_hour_starts"] <= 2


def test_every_line_states_its_source() -> None:
    """Also of what is given, and of what only waits to be used."""
    text = format_new_site({**HOUSE, "cistern_height": 1.5})
    entries = re.findall(r"^[a-z]\w*: \S+ +# .*(?:\n +# .*)*", text, re.MULTILINE | re.IGNORECASE)
    assert len(entries) == len(re.findall(r"^\w+:", text, re.MULTILINE)) - 1  # extends
    assert all(re.search(r"\[[^]]+\]$", entry) for entry in entries)
    assert len(re.findall(r"\[given\]$", text, re.MULTILINE)) == 6


def drain_hours(site: Site, from_level: float) -> float:
    """Return how long the low outlet takes, in steps of a second by Euler's method (h)."""
    x1, seconds = from_level * site.a1, 0
    while x1 / site.a1 > (site.low_outlet_level or 0) + 1e-4:
        x1 -= low_outlet_flow(site, x1)
        seconds += 1
    return seconds / 3600


def test_a_valve_empties_the_full_cistern_in_half_a_day(tmp_path: Path) -> None:
    file = tmp_path / "my_site.yaml"
    file.write_text(format_new_site(HOUSE, valve=True))
    site = read_site(file)
    assert site.low_outlet_valve and site.low_outlet_level == 0.1
    assert drain_hours(site, 2.0) == pytest.approx(12, rel=0.03)


def test_the_mains_keep_up_with_the_pump(tmp_path: Path) -> None:
    """With 20 mm/h on 120 m2 they give 1.2 times 2.4 m3/h."""
    file = tmp_path / "my_site.yaml"
    assert made(file).mains_flow == 2e-4
    assert made(file, irrigation_rate=20.0).mains_flow == pytest.approx(2.88 / 3600, rel=0.02)


@pytest.mark.parametrize("name", SUBSTRATES)
def test_targets(tmp_path: Path, name: str) -> None:
    """Plants have enough water at the target, and it does not drain off; a thin substrate, too.

    Water and drainage layer are within published ranges.
    """
    file, substrate = tmp_path / "my_site.yaml", SUBSTRATES[name]
    capacity, wilting = substrate["field_capacity"], substrate["wilting_point"]
    assert 0.08 <= capacity - wilting <= 0.61 and 0.001 <= substrate["drainage_storage"] <= 0.02
    for depth in (None, 0.02, 1.0):
        given = {} if depth is None else {"substrate_depth": depth}
        site = made(file, substrate=name, **given)
        content = site.z_veg / site.z_soil
        assert (site.field_capacity, site.wilting_point) == (capacity, wilting)
        assert (capacity + wilting) / 2 < content <= 0.95 * capacity


def test_sizes_from_a_shed_to_a_hospital(tmp_path: Path) -> None:
    """All are sites, and none has a pump that its own roof or tick would make us note."""
    for scale in (0.01, 0.1, 1, 100, 1000):
        sizes = {key: scale * HOUSE[key] for key in (
            "roof_area", "catchment_area", "cistern_volume",
        )}
        file = tmp_path / "my_site.yaml"
        site = made(file, **sizes)
        assert site.x2_star == pytest.approx(site.a2 * site.z_veg)
        inputs = make_inputs(find_controller("onoff"), {"site": file, "weather": str(WEATHER)})
        assert inputs.build().notes() == []


@pytest.mark.parametrize(("place", "options", "expected"), [
    # South of the equator a place begins with a minus.
    ("-33.87,151.21", (), (-33.87, 151.21, None, 0.16)),
    # The value of FAO-56, Eq. 50, on a coast.
    ("52.52, 13.40", ("--time-zone", "Europe/Berlin", "--coast"), (52.52, 13.4, 1.0, 0.19)),
    ("1.87,-157.4", ("--time-zone", "Pacific/Kiritimati"), (1.87, -157.4, 14.0, 0.16)),
])
def test_places(
    tmp_path: Path, place: str, options: tuple[str, ...], expected: tuple[float | None, ...]
) -> None:
    ended = new_site(tmp_path, *GIVEN[:-1], place, *options)
    assert ended.returncode == 0, ended.stderr
    site = read_site(tmp_path / "my_site.yaml")
    assert (site.latitude, site.longitude, site.utc_offset, site.k_Rs) == expected


@pytest.mark.parametrize(("key", "options"), [
    ("--catchment, --cistern, --place", GIVEN[:2]), ("--roof", (*GIVEN, "--roof", "12,5")),
    ("--output", (*GIVEN, "--output", "none/my_site.yaml")),
    ("time_zone", (*GIVEN, "--time-zone", "Mars")),
    *(("--place", (*GIVEN[:-1], place)) for place in ("91,0", "43,63,-79,40", "-79.40,43.63")),
])
def test_bad_answers(tmp_path: Path, options: tuple[str, ...], key: str) -> None:
    """Exit code 2, a line, and no file."""
    ended = new_site(tmp_path, *options)
    assert ended.returncode == 2 and key in ended.stderr and "Traceback" not in ended.stderr
    assert not list(tmp_path.iterdir())
