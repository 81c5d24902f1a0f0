"""Keys of a site file in words that people have, and what they stand for."""

from __future__ import annotations

from pathlib import Path

import pytest
from refusals import refusal
from studies import GRID, cases_of, grid

import greenroof_ros as gr
from greenroof_ros.base.files import shared_directory
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.site.file import DETERMINES, format_site, read_site
from greenroof_ros.site.site import Site

# A house with a garden on its roof.
HOUSE: dict[str, object] = {
    "z_veg": "0.03",
    "cistern_volume": "5.0", "cistern_height": "2.0", "roof_area": "120", "catchment_area": "200",
    "substrate": "extensive", "substrate_depth": "0.1", "irrigation_rate": "3.0",
}


def write(path: Path, extends: str = "site.yaml", **values: object) -> Path:
    """Write a site file, one key a line, from the second line on; None leaves a key out."""
    lines = [f"{key}: {value}" for key, value in values.items() if value is not None]
    path.write_text("\n".join([f"extends: {extends}", *lines]) + "\n")
    return path


def house(path: Path, **changes: object) -> Path:
    return write(path, **{**HOUSE, **changes})


def litres_per_hour(site: Site, level: float) -> float:
    return maximum_pump_flow(site, level * site.a1) * 3600 * 1000


def test_what_plain_keys_stand_for(tmp_path: Path) -> None:
    """5 m3 up to an overflow at 2 m stand on 2.5 m2; the substrate holds 35 % of 12 m3."""
    site = read_site(house(tmp_path / "house.yaml"))
    assert (site.a1, site.z_o, site.a2, site.a_in, site.z_soil) == (2.5, 2.0, 120.0, 200.0, 0.1)
    assert (site.field_capacity, site.wilting_point, site.depletion_fraction) == (0.35, 0.1, 0.5)
    assert (site.z_cap, site.x2_star) == pytest.approx((4.2, 3.6))
    written = tmp_path / "whole.yaml"
    written.write_text(format_site(site))
    assert read_site(written) == site


@pytest.mark.parametrize(
    ("given", "flow"), [
        ({"irrigation_rate": 3}, 360.0),  # mm/h on 120 m2
        ({"irrigation_rate": None, "pump_flow": 900}, 900.0),
        ({"irrigation_rate": None, "emitters": 150, "emitter_flow": 2.3}, 345.0),
        # From 1 to 1e6 l/h, with high cisterns and with long, narrow pipes to high roofs.
        ({"irrigation_rate": None, "pump_flow": 1, "cistern_height": 50, "d": 66}, 1.0),
        ({"irrigation_rate": None, "pump_flow": 1e6, "d": 300, "l": 1000, "D": 0.02}, 1e6),
    ],
)
def test_a_constant_flow(tmp_path: Path, given: dict[str, object], flow: float) -> None:
    """At any level, within half a millionth for each metre, whatever pipe and lift are."""
    site = read_site(house(tmp_path / "house.yaml", **given))
    for level in (0.0, 0.05, 1.0, site.z_o):
        excess = litres_per_hour(site, level) / flow - 1
        assert -1e-9 < excess <= 0.5e-6 * level + 1e-9


def test_of_levels_the_upper_takes_precedence(tmp_path: Path) -> None:
    """Whatever name it uses; what it does not give stays, and follows."""
    house(tmp_path / "house.yaml")
    own = tmp_path / "own.yaml"

    def read(**values: object) -> Site:
        return read_site(write(own, "house.yaml", **values))

    assert (read(a1=4).a1, read(a1=4).z_o) == (4.0, 2.0)
    assert (read(cistern_volume=8).a1, read(z_o=2.5).a1, read(cistern_height=4).a1) == (4, 2, 1.25)
    assert read(roof_area=60).a2 == 60 and read(a2=60, x2_star=1.8).a2 == 60
    # 3 mm/h on half the roof; another way to give a flow replaces it; a curve is a whole one.
    assert litres_per_hour(read(roof_area=60), 0) == pytest.approx(180)
    assert litres_per_hour(read(pump_flow=900), 0) == pytest.approx(900)
    assert litres_per_hour(read(emitters=10, emitter_flow=2), 0) == pytest.approx(20)
    curve = read(a_hat=-5.69e5, c_hat=55.0)
    assert (curve.a_hat, curve.c_hat) == (-5.69e5, 55.0)
    assert "own.yaml: c_hat: is missing" in refusal(read_site, write(own, "house.yaml", a_hat=-5e5))
    # A value of its own replaces the substrate's, another substrate replaces both.
    assert read(field_capacity=0.4).field_capacity == 0.4
    assert read(field_capacity=0.4).wilting_point == 0.1
    house(own, substrate=None, field_capacity=0.4, wilting_point=0.05, depletion_fraction=0.4)
    site = read_site(write(tmp_path / "third.yaml", "own.yaml", substrate="intensive", z_veg=0.035))
    assert (site.field_capacity, site.wilting_point, site.depletion_fraction) == (0.45, 0.1, 0.5)


def test_another_place_takes_nothing_from_the_first(tmp_path: Path) -> None:
    """Toronto's clock, height, coast and climate do not follow a site to Graz."""
    site = read_site(house(tmp_path / "house.yaml", latitude=47.07, longitude=15.44))
    assert (site.elevation, site.utc_offset, site.monthly_evapotranspiration) == (None, None, None)
    assert site.k_Rs == 0.16
    own = read_site(house(tmp_path / "house.yaml", latitude=47.07, longitude=15.44, elevation=353))
    assert own.elevation == 353
    # One of them is a correction.
    assert read_site(house(tmp_path / "house.yaml", latitude=43.7)).utc_offset == -5


CONTRADICTIONS = [
    ("cistern_volume", "a1"), ("cistern_height", "z_o"), ("roof_area", "a2"),
    ("catchment_area", "a_in"), ("substrate_depth", "z_soil"), ("irrigation_rate", "a_hat"),
    ("irrigation_rate", "c_hat"), ("irrigation_rate", "pump_flow"), ("irrigation_rate", "emitters"),
    ("irrigation_rate", "emitter_flow"),
    *(("substrate", name) for name in (
        "field_capacity", "wilting_point", "depletion_fraction", "drainage_storage",
        "drainage_time",
    )),
]


@pytest.mark.parametrize(("plain", "other"), CONTRADICTIONS)
def test_contradictions(tmp_path: Path, plain: str, other: str) -> None:
    """In one file; the error names both, with their lines, in either order."""
    value = -1e5 if other == "a_hat" else 3
    for keys in ({plain: HOUSE[plain], other: value}, {other: value, plain: HOUSE[plain]}):
        path = write(tmp_path / "own.yaml", **keys)
        # Of two plain keys the first is refused, otherwise the plain one.
        of, by = [*keys] if other in DETERMINES else (plain, other)
        lines = {key: 2 + number for number, key in enumerate(keys)}
        message = refusal(read_site, path)
        assert message.startswith(f"{path}, line {lines[of]}: {of} = ")
        assert f": contradicts {by} = {keys[by]} in line {lines[by]}, " in message
        assert f"{of} = " in refusal(read_site, house(path), keys)


@pytest.mark.parametrize(
    ("key", "range_"), [
        ("cistern_volume", "from 0.01 to 5000 m3"), ("cistern_height", "from 0.1 to 50 m"),
        ("catchment_area", "from 0.1 to 1000000 m2"), ("roof_area", "from 0.1 to 1000000 m2"),
        ("substrate_depth", "from 0.02 to 2 m"), ("pump_flow", "from 1 to 1000000 l/h"),
        ("irrigation_rate", "from 0.1 to 1000 mm/h"), ("emitter_flow", "from 0.1 to 100 l/h"),
        ("emitters", "from 1 to 10000000"), ("mains_flow", "from 1e-06 to 0.2 m3/s"),
    ],
)
def test_what_is_no_number_of_its_range(tmp_path: Path, key: str, range_: str) -> None:
    """Nor is one with a unit, a decimal comma, or in a unit that is a thousandth of ours."""
    for value in ("-1", "0", ".nan", ".inf", "1e12", "many", "true", "[5]", "5 m3", '"5,5"'):
        path = house(tmp_path / "own.yaml", **{"irrigation_rate": None, key: value})
        message = refusal(read_site, path)
        assert f"{path}, line " in message and f": {key} = " in message
        assert f" number {range_}" in message
    path = house(tmp_path / "own.yaml", **{"irrigation_rate": None, key: ""})
    assert f": {key}: must have a value; leave this line out" in refusal(read_site, path)


@pytest.mark.parametrize(
    ("given", "message"), [
        ({"cistern_height": 2000}, "line 4: cistern_height = 2000: must be a number from 0.1 to"),
        # With a unit or a decimal comma it is no number; it is refused under the name in the file.
        ({"cistern_height": "2 m"}, "line 4: cistern_height = '2 m': must be a number from 0.1 to"),
        ({"cistern_volume": '"5,5"'}, "line 3: cistern_volume = '5,5': must be a number from 0.01"),
        ({"cistern_volume": ""}, "line 3: cistern_volume: must have a value; leave this line out"),
        ({"substrate_depth": 10}, "line 8: substrate_depth = 10: must be a number from 0.02 to 2"),
        ({"substrate": "sand"}, "line 7: substrate = 'sand': is unknown; did you mean sandy_loam?"),
        ({"substrate": "moss"}, "line 7: substrate = 'moss': must be one of neubrandenburg"),
        ({"substrate": 3}, "line 7: substrate = 3: must be one of neubrandenburg"),
        ({"irrigation_rate": None, "emitters": 3}, "line 9: emitters = 3: needs emitter_flow as"),
        ({"irrigation_rate": None, "emitter_flow": 3}, "line 9: emitter_flow = 3.0: needs emit"),
        ({"irrigation_rate": None, "emitters": 2.5}, "line 9: emitters = 2.5: must be a whole"),
        ({"volume": 3}, "line 10: volume = 3: is not a valid key; did you mean cistern_volume?"),
        # What is wrong with the parameter that a plain key stands for.
        ({"initial_cistern": 90, "initial_roof": 3}, "initial_cistern = 90.0: must be at most 6.5"),
        ({"substrate_depth": 0.02}, "line 2: z_veg = 0.03: must be below z_cap / a2 = 0.007 m"),
    ],
)
def test_wrong_values(tmp_path: Path, given: dict[str, object], message: str) -> None:
    """The error has file, line, key and value, and what would be right."""
    path = house(tmp_path / "own.yaml", **given)
    assert message in refusal(read_site, path)


def test_in_python_and_in_the_grid_of_a_study(tmp_path: Path) -> None:
    """Initial volumes follow, too: half a cistern stays half a cistern."""
    file = house(tmp_path / "house.yaml", initial_cistern=2.5, initial_roof=3.6)
    site = gr.read_site(file, cistern_volume=10.0, roof_area=60.0, substrate="intensive")
    assert (site.a1, site.initial_cistern, site.initial_roof) == (5.0, 5.0, 1.8)
    flat = gr.read_site(file, cistern_height=1.0)  # as much water, on twice the area
    assert (flat.a1, flat.initial_cistern) == (5.0, 2.5)
    both = gr.read_site(file, cistern_volume=10.0, cistern_height=4.0)
    assert (both.a1, both.initial_cistern) == (2.5, 5.0)
    assert gr.read_site(file, z_o=4.0, a1=2.5).initial_cistern == 5.0
    assert gr.read_site(cistern_volume=6.0).a1 == 2.0  # the paper's overflow is at 3 m
    text = GRID.replace(
        str(shared_directory() / "config" / "site.yaml"),
        "{file: house.yaml, roof_area: [60, 120], substrate: [extensive, intensive]}",
    ).replace("cistern: 40.0", "cistern: 4.0")
    sites = {case.site for case in cases_of(tmp_path / grid(tmp_path, text))}
    assert {(site.a2, site.field_capacity) for site in sites} == {
        (area, capacity) for area in (60, 120) for capacity in (0.35, 0.45)
    }
