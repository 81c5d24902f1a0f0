"""Initial volumes: only those that a place can hold."""

from __future__ import annotations

from pathlib import Path

import pytest
from paper import PAPER_SITE, paper_run, site_file

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.physics.start import check_volumes


def test_what_rain_makes_of_a_full_roof_is_taken() -> None:
    """34.4 m3 plus 1.825 m on 68.8 m2, a day's maximum rain: a run may start there, not above."""
    check_volumes(PAPER_SITE, 399.9, 159.9)
    with pytest.raises(ConfigurationError, match=r"^--roof = 160.0: must be at most 159.96 m3"):
        paper_run("--cistern", "60", "--roof", "160")


def test_more_than_the_soil_holds_is_noted() -> None:
    """45.7 may be the target in mm: it is accepted, with a note before the results."""
    (note,) = paper_run("--cistern", "60", "--roof", "45.7").notes()
    assert note.startswith("the run starts with 45.7 m3 on the roof, more than the 34.4 m3")
    assert paper_run("--cistern", "0", "--roof", "34.4").notes() == []


def test_a_sites_own_state_is_what_a_run_begins_in(tmp_path: Path) -> None:
    """Unless the command line gives another one, by name or by volumes."""
    options = ("--site", str(site_file(tmp_path, initial_cistern=70.0, initial_roof=1.5)))
    run = paper_run(*options)
    assert (run.initial, run.x1, run.x2) == ("site", 70.0, 1.5)
    # Table II: a1 z_o and a2 z_veg, divided or multiplied by 1.3.
    for name, cistern, roof in (
        ("low-low", 75 / 1.3, 3.14416 / 1.3), ("high-low", 75 * 1.3, 3.14416 / 1.3),
        ("high-high", 75 * 1.3, 3.14416 * 1.3),
    ):
        named = paper_run(*options, "--initial", name)
        assert named.initial == name
        assert (named.x1, named.x2) == pytest.approx((cistern, roof), rel=1e-12)
    custom = paper_run(*options, "--cistern", "60", "--roof", "2")
    assert (custom.initial, custom.x1, custom.x2) == ("custom", 60.0, 2.0)
    assert paper_run().initial == "low-low"
    for others, wrong in (
        (("--initial", "low-low", "--cistern", "60", "--roof", "2"), "differs from the volumes"),
        (("--cistern", "60"), "--roof: is missing; set both cistern and roof"),
    ):
        with pytest.raises(ConfigurationError, match=wrong):
            paper_run(*others)
    with pytest.raises(ConfigurationError, match="requires initial_cistern and initial_roof in"):
        paper_run("--initial", "site")
