"""The designs of a site, what is assumed for them, and which of them is chosen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from places import CONFIG, refusal

from greenroof_ros.analysis.assumptions import list_ends
from greenroof_ros.analysis.sizing.designs import (
    OUTLETS,
    Design,
    build,
    check_mains,
    choose_targets,
    choose_volumes,
    find_knee,
    find_target,
    list_assumed,
    read_outlets,
    refine_targets,
    refine_volumes,
)
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.site.file import check_site, read_site

VALVE = CONFIG / "site_valve.yaml"


def test_default_volumes() -> None:
    """Preferred numbers of ISO 3 from 4 mm on 338.8 m2, 1.36 m3, and the site's 10 or 12 m3."""
    site = read_site(VALVE)
    assert choose_volumes(site) == [1.6, 2.5, 4.0, 6.3, 10.0, 16.0, 25.0, 40.0]
    assert choose_volumes(read_site(VALVE, {"a1": 6.0}))[4:6] == [10.0, 12.0]
    large = read_site(VALVE, {"a_in": 30_000.0, "r_o": 1.0})
    assert choose_volumes(large)[1:3] == [160.0, 250.0]  # 4 mm on 27,069 m2 are 108 m3
    assert refine_volumes([6.3, 10.0, 16.0], 10.0) == [7.1, 8.0, 9.0, 11.2, 12.5, 14.0]
    assert refine_volumes([6.3, 10.0, 16.0], 16.0) == [11.2, 12.5, 14.0]


def test_default_targets() -> None:
    """A twentieth of 68.04 mm is 3.4 mm; 2.16 mm of them are of no use to plants."""
    site = read_site(VALVE)
    targets = choose_targets(site)
    assert (targets[:2], targets[-1], len(targets)) == ([3.4, 6.8], 64.6, 20)
    assert 39.0 in targets
    assert refine_targets(site, 37.4) == [34.8, 35.7, 36.5]


def test_designs_of_a_site() -> None:
    """Its cisterns have its height and its levels; without an outlet there is no valve."""
    site = read_site(VALVE, {"valve_moves_per_hour": 4.0, "valve_travel_time": 9.0})
    assert read_outlets(None, site) == [*OUTLETS]
    for outlet in OUTLETS:
        built, parameters = build(site, Design(5.0, 36.0, outlet))
        assert built.a1 * built.z_o == pytest.approx(5.0)
        assert built.x2_star == pytest.approx(0.036 * site.a2)
        assert built.mains_level == site.mains_level
        assert built.low_outlet_valve == (outlet != "none")
        assert check_site(built).valve_moves_per_hour == (4.0 if outlet != "none" else None)
        assert parameters.get("outlet", "none") == outlet
    assert built.low_outlet_radius == site.low_outlet_radius


def test_what_a_site_lacks() -> None:
    """Without a low outlet there is no valve; a site without mains is refused."""
    bare = read_site(CONFIG / "site.yaml")
    assert read_outlets(None, bare) == ["none"]
    assert list_assumed(bare)[-1].startswith("No valve is compared")
    refusal(read_outlets, ["plan"], bare, match="outlets = 'plan': needs a low outlet in the site")
    refusal(check_mains, bare, match="no mains top-up")


def test_ends_of_the_assumptions() -> None:
    """One at a time; the percolation below field capacity needs a field capacity."""
    site, inputs = read_site(VALVE), make_inputs(find_controller("onoff"), {})
    again = list[tuple[object, object]]()
    ends = list_ends(site, inputs, {}, lambda *read: again.append(read) or {})
    words, changes, _ = zip(*ends, strict=True)
    assert changes == (
        {}, {"percolation_exponent": 1.5}, {"percolation_exponent": 3.0}, {"wet_after": 1.0},
        {"wet_after": 6.0}, {"runoff_coefficient": 0.75}, {"runoff_coefficient": 0.95},
        {"k_Rs": 0.16}, {"k_Rs": 0.19}, {}, {}, {}, {},
    )
    values = ["", "1.5", "3", "1", "6", "0.75", "0.95", "0.16", "0.19", "0.9", "1.2", "1.5", "3"]
    assert [each["value"] for each in words] == values
    assert words[4]["assumption"].endswith("(h); used: 2")
    # Only for these, the weather is read again.
    assert again == [
        *((replace(site, k_Rs=value), inputs) for value in (0.16, 0.19)),
        *((site, replace(inputs, rain_factor=value)) for value in (0.9, 1.2)),
        *((site, replace(inputs, temperature_change=value)) for value in (1.5, 3.0)),
    ]
    papers = read_site(CONFIG / "site.yaml")
    _, (_, change, _), *_ = list_ends(papers, inputs, {}, lambda *read: {})
    assert change == {"wet_after": 1.0}


def test_an_orifice_gets_a_valve() -> None:
    """For none it is left out, and the note says so."""
    site = read_site(VALVE, {"low_outlet_valve": False})
    assert [
        build(site, Design(5.0, 39.0, outlet))[0].low_outlet_level is None for outlet in OUTLETS
    ] == [True, False, False]
    assert "on the low outlet of the site" in list_assumed(site)[-1]


VOLUMES = [1.0, 2.0, 4.0, 8.0]


@pytest.mark.parametrize(("saved", "amount", "knee"), [
    ([0, 5, 7, 7.4], 1.0, 2),  # 5, 1 and 0.1 m3 for each m3
    ([0, 5, 7, 7.4], 1.01, 1),
    ([0, 0.9, 1.0, 1.1], 1.0, 0),
    ([0, 0.5, 3.5, 3.6], 1.0, 2),  # a m3 that brings little, before one that brings much
    ([0, 5, 10, 20], 1.0, 3),  # the largest may be too small
    ([0, 0, 0, 0], 0.0, 3),  # at least nothing is always brought
])
def test_knee(saved: list[float], amount: float, knee: int) -> None:
    """It is the smallest volume from which on every further m3 brings less than the amount."""
    assert find_knee(VOLUMES, np.array(saved), amount) == knee


@pytest.mark.parametrize(("lost", "target"), [
    ([0.2, 0.001, 0.0], 39.0), ([0.2, 0.05, 0.02], 43.0), ([0.0, 0.0, 0.0], 35.0),
])
def test_target(lost: list[float], target: float) -> None:
    """The lowest at which at most 0.1 % is lost, or else the one at which least is lost."""
    assert find_target([35.0, 39.0, 43.0], np.array(lost)) == target
