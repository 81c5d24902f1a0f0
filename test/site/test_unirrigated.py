"""A roof without pumps is a site like any other."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from places import CHECKOUT, CONFIG

import greenroof_ros as gr
from greenroof_ros.site.file import format_site, read_site

_PUMP = ("a_hat", "c_hat", "a_pump", "D", "F", "k_L", "l", "z_pump", "z_H")


def test_a_site_without_irrigation_needs_no_pump(tmp_path: Path) -> None:
    """Without the nine keys of the pumps, which the paper's file contains."""
    lines = (CONFIG / "site.yaml").read_text(encoding="utf-8").splitlines()
    file = tmp_path / "dry.yaml"
    kept = [line for line in lines if line.partition(":")[0] not in _PUMP]
    file.write_text("\n".join([*kept, "irrigation: none"]) + "\n", encoding="utf-8")
    site = read_site(file)
    assert not site.irrigated and site.b == 0 and site.suction_level == 0
    copy = tmp_path / "copy.yaml"
    copy.write_text(format_site(site), encoding="utf-8")
    assert read_site(copy) == site


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("controller", ["onoff", "mpc", "lookahead"])
def test_nothing_is_commanded_or_pumped(controller: str) -> None:
    site = gr.read_site(CONFIG / "site.yaml", irrigation="none")
    metrics = gr.simulate(controller, site=site, hours=0.5).metrics
    assert metrics["pumped_m3"] == metrics["max_command"] == metrics["pump_starts"] == 0


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_season_in_toronto_beside_york_university() -> None:
    """The table of doc/explanation/roof.md has what the example prints.

    York University's roof in Toronto kept 63 to 65 % of its rain (TRCA 2006); 2021 was wet.
    """
    page = (CHECKOUT / "doc" / "explanation" / "roof.md").read_text(encoding="utf-8")
    kept = []
    for exponent in (1.5, 2.0, 3.0):
        site = gr.read_site(
            CONFIG / "site_catchment.yaml", irrigation="none", substrate="extensive",
            substrate_depth=0.1, z_veg=0.03, percolation_exponent=exponent, tau=300.0,
            initial_cistern=0.0, initial_roof=0.35 * 0.1 * 68.8,
        )
        metrics = gr.simulate(
            site=site, weather=CONFIG / "weather" / "toronto_2021.csv", gaps="fill",
            start="2021-05-01", hours=4416,
        ).metrics
        kept.append(metrics["roof_retention_share"])
        fallen = metrics["rain_roof_m3"] - metrics["evapotranspiration_m3"] - metrics["drainage_m3"]
        stored = metrics["final_roof_m3"] + metrics["final_layer_m3"] - 0.35 * 0.1 * 68.8
        assert math.isclose(fallen, stored, abs_tol=1e-6)
    low, usual, high = (f"{100 * share:.0f}" for share in kept)
    assert f"{low}, {usual} and {high} %\nfor 100 mm" in page
    assert kept[0] < 0.63 < 0.66 < kept[2]
