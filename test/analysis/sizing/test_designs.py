"""The designs of a site, and what is assumed for them."""

from __future__ import annotations

import math

import pytest
from places import CONFIG

from greenroof_ros.analysis.sizing.designs import (
    OUTLETS,
    choose_targets,
    choose_volumes,
    make_designs,
)
from greenroof_ros.physics.cistern import low_outlet_flow
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.site.file import check_site, read_site

VALVE = CONFIG / "site_valve.yaml"


def test_default_volumes_and_targets() -> None:
    """Preferred numbers of ISO 3 from 4 mm on 338.8 m2, 1.36 m3; a day's irrigation each way."""
    site = read_site(VALVE)
    assert choose_volumes(site) == [1.6, 2.5, 4.0, 6.3, 10.0, 16.0, 25.0, 40.0]
    assert choose_targets(site) == [35.0, 39.0, 43.0]
    large = read_site(VALVE, {"a_in": 30_000.0, "r_o": 1.0})
    assert choose_volumes(large)[:2] == [160.0, 250.0]  # 4 mm on 27,069 m2 are 108 m3


def test_targets_that_the_soil_cannot_keep_are_left_out() -> None:
    """This soil holds 68 mm, and 2 mm of them are of no use to plants."""
    assert choose_targets(read_site(VALVE, {"z_veg": 0.066})) == [62.0, 66.0]
    assert choose_targets(read_site(VALVE, {"z_veg": 0.005})) == [5.0, 9.0]


def test_a_site_with_all_of_it_needs_no_assumption() -> None:
    """Its cisterns have its height and its levels; without an outlet there is no valve."""
    site = read_site(VALVE, {"valve_moves_per_hour": 4.0, "valve_travel_time": 9.0})
    designs, notes = make_designs(site, [5.0, 20.0], [39.0], OUTLETS)
    assert [(design.outlet, design.volume) for design in designs] == [
        (outlet, volume) for outlet in OUTLETS for volume in (5.0, 20.0)
    ]
    assert not any("Assumed" in note for note in notes)
    for design in designs:
        assert design.site.a1 * design.site.z_o == pytest.approx(design.volume)
        assert design.site.mains_level == site.mains_level
        assert design.site.low_outlet_valve == (design.outlet != "none")
        assert check_site(design.site).valve_moves_per_hour == (
            4.0 if design.site.low_outlet_valve else None
        )
        assert design.parameters.get("outlet", "none") == design.outlet
    assert designs[-1].site.low_outlet_radius == site.low_outlet_radius


def test_assumptions_are_named() -> None:
    """Table I has neither mains nor valve: 10 mm/h on 68.8 m2 are 0.688 m3/h."""
    designs, notes = make_designs(read_site(CONFIG / "site.yaml"), [5.0], [45.7], OUTLETS)
    assumed = [note for note in notes if note.startswith("Assumed")]
    assert len(assumed) == 2
    assert "a level of 0.77 m, 20 mm above the pumps' suction level" in assumed[0]
    assert "0.688 m³/h, which is 10 mm/h over the roof" in assumed[0]
    assert "a level of 0.8 m, 30 mm above the level of the mains" in assumed[1]
    assert designs[0].site.mains_flow == pytest.approx(0.688 / 3600)


@pytest.mark.parametrize("volume", [2.0, 50.0])
def test_the_assumed_valve_empties_any_cistern_in_twelve_hours(volume: float) -> None:
    """Stepped second by second to 1 mm above the outlet, where it still loses the last of it."""
    designs, _ = make_designs(read_site(CONFIG / "site.yaml"), [volume], [45.7], ["drain"])
    site, stored, seconds = designs[0].site, volume, 0
    numbers = plant_parameters(site)
    while stored > site.a1 * (site.low_outlet_level or 0.0) + 1e-3 * site.a1:
        stored -= low_outlet_flow(numbers, stored)
        seconds += 1
    # The root of the head falls linearly, so the last mm of 2.2 m takes 2 % of the time.
    assert seconds / 3600 == pytest.approx(12 * (1 - math.sqrt(1e-3 / 2.2)), rel=1e-3)


def test_an_orifice_gets_a_valve() -> None:
    """For none it is left out, and the note says so."""
    site = read_site(VALVE, {"low_outlet_valve": False})
    designs, notes = make_designs(site, [5.0], [39.0], OUTLETS)
    assert [design.site.low_outlet_level is None for design in designs] == [True, False, False]
    assert sum("which has no valve, gets a valve" in note for note in notes) == 1
