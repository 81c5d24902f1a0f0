"""Initial volumes: only those that a place can hold."""

from __future__ import annotations

from pathlib import Path

import pytest
from paper import paper_run, site_file

from greenroof_ros.base.errors import ConfigurationError


@pytest.mark.parametrize(("cistern", "roof", "wrong"), [
    # Table II: 1.3 times the 75 m3 up to the overflow at 3 m; the soil holds 68.8 m2 x 0.5 m.
    ("98", "2", "--cistern = 98.0: must be at most 97.5 m3"),
    ("60", "34.5", "--roof = 34.5: must be at most 34.4 m3"),
    ("60", "45.7", "is the unit wrong"),  # the target in mm
])
def test_a_run_begins_with_what_cistern_and_roof_can_hold(
    cistern: str, roof: str, wrong: str
) -> None:
    assert paper_run("--cistern", "97.5", "--roof", "34.4").x1 == 97.5
    with pytest.raises(ConfigurationError, match=wrong):
        paper_run("--cistern", cistern, "--roof", roof)


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
    for wrong in (
        ("--initial", "low-low", "--cistern", "60", "--roof", "2"), ("--cistern", "60"),
        ("--initial", "site"),
    ):
        with pytest.raises(ConfigurationError):
            paper_run(*wrong)
