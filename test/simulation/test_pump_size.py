"""Pumps that are too large for the roof, or for the tick, are noted."""

from __future__ import annotations

import warnings

import pytest
from studies import CONFIG, WEATHER

import greenroof_ros as gr
from greenroof_ros.simulation.run import note_pumps
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site


def of(name: str, **changes: object) -> Site:
    return read_site(CONFIG / name, changes)


@pytest.mark.parametrize("flow", [28_800.0, 1450.0, 1430.0])
def test_a_flow_on_a_roof(flow: float) -> None:
    """8 l/s on 40 m2 are 720 mm/h; the limit, 0.6 mm/min, is 1440 l/h there."""
    notes = [*note_pumps(of("site_neubrandenburg.yaml", pump_flow=flow, roof_area=40.0))]
    if flow < 1440:
        assert notes == []
    else:
        [note] = notes
        shown = "8 l/s, or 720 mm/h on 40 m2" if flow > 2000 else "0.403 l/s, or 36 mm/h on 40 m2"
        assert f"the pumps can deliver {shown}" in note and "to absorb 36 mm/h; the excess" in note


@pytest.mark.parametrize(("tau", "noted"), [(60.0, False), (62.0, False), (64.0, True)])
def test_a_tick(tau: float, noted: bool) -> None:
    """1 l/s on 40 m2 moves 63 l in 63 s, a tenth of 40 m2 times 15.75 mm; Table I's soil."""
    site = of("site.yaml", pump_flow=3600.0, roof_area=40.0, z_veg=0.01575, tau=tau)
    notes = [*note_pumps(site)]
    assert bool(notes) == noted
    if noted:
        assert notes[0].startswith("in a tick of 64 s the pumps can deliver 10% of the target")
        assert notes[0].endswith("or ticks of at most 63 s")


def test_shipped_sites() -> None:
    """The paper's run has no note; with a real soil its pump has: 8.4 l/s are 441 mm/h on 68.8 m2.

    Eqs. (3): sqrt((55.2 - 16 + 3) / (578000 + (3.56 * 18.4 / 0.2 + 0.6) / (2 g a_pump^2))) m3/s.
    """
    assert [*note_pumps(of("site.yaml"))] == []
    for name in ("site_neubrandenburg.yaml", "site_catchment.yaml"):
        [note] = note_pumps(of(name))
        assert "the pumps can deliver 8.42 l/s, or 441 mm/h on 68.8 m2 of roof" in note
    first, second = note_pumps(of("site_valve.yaml", tau=300.0))
    # 300 s of 8.32 l/s are 2.497 m3 of 2.683 m3.
    assert "8.32 l/s" in first and second.startswith("in a tick of 300 s the pumps can deliver 93%")


def test_where_they_are_seen() -> None:
    """In Python as a warning, and in the summary of a run, as those of a study have."""
    with pytest.warns(UserWarning, match="441 mm/h on 68.8 m2"):
        result = gr.simulate(
            "onoff", site=CONFIG / "site_catchment.yaml", weather=WEATHER, hours=0.1,
        )
    assert any("441 mm/h" in note for note in result.summary["notes"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gr.simulate("onoff", hours=0.1)
