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

from greenroof_ros.commands.new_site_file import format_new_site
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.physics.cistern import low_outlet_flow
from greenroof_ros.physics.pump import maximum_pump_flow
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
    again = new_site(tmp_path, *GIVEN)
    assert again.returncode == 2 and "--output = 'my_site.yaml': exists" in again.stderr


def test_every_line_states_its_source() -> None:
    """Also of what is given, and of what only waits to be used; lines fit a page."""
    text = format_new_site({**HOUSE, "cistern_height": 1.5})
    entries = re.findall(r"^[a-z]\w*: \S+ +# .*(?:\n +# .*)*", text, re.MULTILINE | re.IGNORECASE)
    assert len(entries) == len(re.findall(r"^\w+:", text, re.MULTILINE)) - 1  # extends
    assert all(re.search(r"\[[^]]+\]$", entry) for entry in entries)
    assert len(re.findall(r"\[given\]$", text, re.MULTILINE)) == 6
    assert max(map(len, text.splitlines())) <= 120


def uncommented(text: str, *keys: str) -> str:
    for key in keys:
        text = re.sub(rf"^# (?={key}:)", "", text, count=1, flags=re.MULTILINE)
    return text


def drain_hours(site: Site, from_level: float) -> float:
    """Return how long the low outlet takes, in steps of a second by Euler's method (h)."""
    x1, seconds = from_level * site.a1, 0
    while x1 / site.a1 > (site.low_outlet_level or 0) + 1e-4:
        x1 -= low_outlet_flow(site, x1)
        seconds += 1
    return seconds / 3600


def test_outlets_ready_to_be_used(tmp_path: Path) -> None:
    """A valve empties the full cistern in 12 h, an orifice its upper half."""
    file = tmp_path / "my_site.yaml"
    text, keys = format_new_site(HOUSE), ("low_outlet_level", "low_outlet_radius")
    file.write_text(uncommented(text, *keys, "low_outlet_valve"))
    valve = read_site(file)
    assert valve.low_outlet_valve and valve.low_outlet_level == 0.1
    assert drain_hours(valve, 2.0) == pytest.approx(12, rel=0.03)
    file.write_text(format_new_site(HOUSE, valve=True))
    assert read_site(file) == valve
    head, tail = text.split("# Or add an orifice")
    file.write_text(head + "# Or add an orifice" + uncommented(tail, *keys))
    orifice = read_site(file)
    assert not orifice.low_outlet_valve and orifice.low_outlet_level == 1.0
    assert drain_hours(orifice, 2.0) == pytest.approx(12, rel=0.03)
    file.write_text(format_new_site(HOUSE, mains=False))
    assert read_site(file).mains_flow is None
    file.write_text(uncommented(file.read_text(), "mains_level", "mains_flow", "elevation",
                                "time_zone"))
    assert read_site(file).mains_flow == 2e-4 and read_site(file).elevation == 100


def test_pumps_of_all_forms(tmp_path: Path) -> None:
    """The mains keep up with them: with 20 mm/h on 120 m2 they give 1.2 times 2.4 m3/h."""
    file = tmp_path / "my_site.yaml"
    for given, litres in (
        ({}, 360.0), ({"pump_flow": 900.0}, 900.0), ({"irrigation_rate": 20.0}, 2400.0),
        ({"emitters": 300, "emitter_flow": 1.6}, 480.0),
    ):
        site = made(file, **given)
        assert 3.6e6 * maximum_pump_flow(site, 0.0) == pytest.approx(litres)
        assert 3.6e6 * (site.mains_flow or 0) == pytest.approx(max(720, 1.2 * litres), rel=0.02)
    assert made(file, pump_flow=900.0, d=12.0).d == 12.0


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
        assert made(file, substrate=name, **given, z_veg=0.9 * site.z_veg).z_veg < site.z_veg


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


@pytest.mark.parametrize(("options", "value"), [((), 0.16), (("--coast",), 0.19)])
def test_a_coast(tmp_path: Path, options: tuple[str, ...], value: float) -> None:
    """The values of FAO-56, Eq. 50; the command names the one it took."""
    ended = new_site(tmp_path, *GIVEN, *options)
    assert f"k_Rs:    {value}, " in ended.stdout
    assert read_site(tmp_path / "my_site.yaml").k_Rs == value


@pytest.mark.parametrize(("place", "zone", "latitude", "offset", "start"), [
    # South of the equator a place begins with a minus, and summer is at the turn of the year.
    ("43.63 -79.40", "", 43.63, None, "2025-06-01"),
    ("-33.87,151.21", "", -33.87, None, "2025-01-01"),
    ("52.52, 13.40", "Europe/Berlin", 52.52, 1.0, "2025-06-01"),
    # Far from their solar time or date: the date line bends around Samoa and Kiribati.
    ("-13.8,-171.8", "Pacific/Apia", -13.8, 13.0, "2025-01-01"),
    ("1.87,-157.4", "Pacific/Kiritimati", 1.87, 14.0, "2025-06-01"),
    ("-17.8,179.9", "Pacific/Fiji", -17.8, 12.0, "2025-01-01"),
    ("39.5,76.0", "Asia/Shanghai", 39.5, 8.0, "2025-06-01"),
])
def test_places(
    tmp_path: Path, place: str, zone: str, latitude: float, offset: float | None, start: str
) -> None:
    """The first run is in summer."""
    options = ("--time-zone", zone) if zone else ()
    ended = new_site(tmp_path, *GIVEN[:-1], place, *options)
    assert ended.returncode == 0, ended.stderr
    site = read_site(tmp_path / "my_site.yaml")
    assert (site.latitude, site.utc_offset) == (latitude, offset)
    assert f"--weather weather.csv --start {start} --hours 720" in ended.stdout


@pytest.mark.parametrize(("key", "options"), [
    ("--roof", GIVEN[2:]), ("--catchment, --cistern, --place", GIVEN[:2]), ("--place", GIVEN[:-2]),
    *((options[0], (*GIVEN, *options)) for options in (
        ("--roof", "12,5"), ("--roof", "nan"), ("--cistern", "5m3"), ("--substrate", "moss"),
        ("--substrate-depth", "10"), ("--time-zone", "Mars"), ("--output", "my_site.txt"),
        ("--output", "none/my_site.yaml"), ("--emitters", "1.5"),
    )),
    ("emitters = 10: needs emitter_flow", (*GIVEN, "--emitters", "10")),
    ("contradicts pump_flow", (*GIVEN, "--pump-flow", "9", "--irrigation-rate", "3")),
    ("must be below z_cap / a2", (*GIVEN, "--target", "108")),
    *(("--place", (*GIVEN[:-1], place)) for place in (
        "91,0", "43,63,-79,40", "43.63", "43.63,-181", "nan,0", "43.63;inf", "Toronto", "",
    )),
    ("did you mean 43.63,-79.4?", (*GIVEN[:-1], "-79.40,43.63")),
    ("'13.4,52.52': is not in Europe/Berlin", (
        *GIVEN[:-1], "13.40,52.52", "--time-zone", "Europe/Berlin",
    )),
])
def test_bad_answers(tmp_path: Path, options: tuple[str, ...], key: str) -> None:
    """Exit code 2, a line, and no file."""
    ended = new_site(tmp_path, *options)
    assert ended.returncode == 2 and key in ended.stderr and "Traceback" not in ended.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("options", "note"), [
    (("--target", "5"), "plants lack water at the target of 5 mm; water stress begins at 35.1 mm"),
    # Litres instead of m3; a large roof is nothing strange.
    (("--cistern", "5000", "--roof", "3000"), "cistern_volume = 5000 m3 is unusual"),
    (("--runoff-coefficient", "0.09"), "runoff_coefficient = 0.09"),
])
def test_what_is_unusual_is_noted(tmp_path: Path, options: tuple[str, ...], note: str) -> None:
    ended = new_site(tmp_path, *GIVEN, *options)
    assert ended.returncode == 0
    assert ended.stderr.startswith(f"note: {note}") and ended.stderr.count("note") == 1
