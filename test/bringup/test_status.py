"""What a live site's console says of what is not well."""

from __future__ import annotations

from greenroof_ros.bringup.status import troubles_of

FILE = ("WARN", "danfoss_fc202.yaml was not verified against a manual", "drive_file_unverified")
STOPPED = ("WARN", "held: an operator stopped it", "operator_stop")
LOST = ("WARN", "no connection to the drive", "drive_awaited")


def test_a_stop_is_said_though_the_drive_file_is_not_verified() -> None:
    """It stands for ever, and has nothing to do with the stop."""
    reports = {"pump": {"diagnoses": {"drive file": FILE, "pump": STOPPED}}}
    assert troubles_of(reports, "") == {
        ("pump", "drive file"): f"pump: {FILE[1]}", ("pump", "pump"): f"pump: {STOPPED[1]}",
    }


def test_the_pump_says_nothing_beside_the_reason() -> None:
    pump = ("WARN", f"unknown: {LOST[1]}", LOST[2])
    reports = {"pump": {"diagnoses": {"drive": LOST, "pump": pump}}}
    assert troubles_of(reports, "") == {("pump", "drive"): f"pump: {LOST[1]}"}


def test_who_misses_a_lost_forecast_says_nothing_beside_the_loss() -> None:
    """But the weather node does, and everybody where nothing is lost."""
    bad = {"diagnoses": {"forecast": ("WARN", "none", "no_forecast")}}
    assert troubles_of({"weather": bad}, "", lasting=True) != {}
    assert troubles_of({"mpc": bad}, "", lasting=True) == {}
    assert troubles_of({"mpc": bad}, "") != {}


def test_what_follows_from_a_loss_is_not_said() -> None:
    old = ("WARN", "/roof/level is older than 5 s", "input_silent")
    reports = {"mpc": {"diagnoses": {"inputs": old}}}
    assert troubles_of(reports, "", lasting=True) == {}
    assert troubles_of(reports, "") != {}
