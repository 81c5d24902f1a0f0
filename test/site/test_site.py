"""The site file: Table I, and what is refused."""

from __future__ import annotations

import re
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from paper import PAPER_SITE, TABLE_I, paper_run, sites
from places import refusal
from studies import GRID, cases_of, grid

from greenroof_ros.base.files import shared_directory
from greenroof_ros.simulation.output import make_run_directory, write_configuration
from greenroof_ros.site.file import format_site, read_site
from greenroof_ros.site.site import Site

FIELD_CAPACITY = {
    "field_capacity": 0.6, "wilting_point": 0.05, "depletion_fraction": 0.5,
    "drainage_storage": 0.01, "drainage_time": 600.0,
}
"""parameters of a roof with a field-capacity soil"""


def write(directory: Path, *extra: str, **changes: object) -> Path:
    """Write Table I as a site file, one key a line, with other values (None: without the key)."""
    values: dict[str, object] = {**TABLE_I, **changes}
    lines = [f"{key}: {value}" for key, value in values.items() if value is not None]
    path = directory / "my site.yaml"
    path.write_text("\n".join([*lines, *extra]) + "\n")
    return path


def test_packaged_site_is_table_i() -> None:
    """Every row has the paper's value, and there is no other row."""
    site = asdict(read_site(shared_directory() / "config" / "site.yaml"))
    assert {key: site[key] for key in TABLE_I} == pytest.approx(TABLE_I, rel=1e-15)
    # The paper's soil drains by Eq. (4), its cistern has no top-up and one outlet, all rain on its
    # inlet arrives, and a run begins in one of Table II's states.
    for key in ("field_capacity", "mains_level", "low_outlet_level", "initial_cistern"):
        assert site[key] is None
    assert (site["initial_layer"], site["runoff_coefficient"]) == (0, 1)
    # What fao56 gives for Toronto's records: 125 mm in July, 0.8 m in a year.
    climate = site["monthly_evapotranspiration"]
    assert 31 * climate[6] == pytest.approx(125, abs=1)
    assert sum(climate) / 12 * 365 == pytest.approx(804, abs=5)


@settings(max_examples=20)
@given(site=sites().map(lambda site: replace(site, a_in=site.a_in / 5e5)))  # no overflow is small
@example(replace(PAPER_SITE, k_L=0.0, z_pump=0.0, z_H=0.0))
def test_any_consistent_site_is_read_back(
    tmp_path_factory: pytest.TempPathFactory, site: Site
) -> None:
    """Exactly; also numbers such as 1e-05, which YAML 1.1 reads as text, and what may be 0."""
    directory = tmp_path_factory.mktemp("site")
    assert read_site(write(directory, **asdict(site))) == site


@pytest.mark.parametrize("key", [key for key in TABLE_I if key not in ("x2_star", "z_cap")])
def test_missing(tmp_path: Path, key: str) -> None:
    """The error has the file, and a remedy that works; the other two follow from these."""
    path = write(tmp_path, **{key: None})
    why = refusal(read_site, path)
    assert why.startswith(f"{path}: {key}: is missing: ")
    (remedy,) = re.findall("begin the file with '(.+?)'", why)
    path.write_text(f"{remedy}\n{path.read_text()}")
    read_site(path)


PAPERS: dict[str, object] = {}
ROOF: dict[str, object] = {"z_cap": 20.64, **FIELD_CAPACITY}
MAINS: dict[str, object] = {"mains_level": 1.0, "mains_flow": 0.001}
LOW: dict[str, object] = {"low_outlet_level": 1.0, "low_outlet_radius": 0.02}
OWN: dict[str, object] = {"initial_cistern": 50.0, "initial_roof": 2.0}
CLOCK: dict[str, object] = {
    "quiet_hours": '["22:00-06:00"]', "time_zone": "EST", "utc_offset": -5,
}


@pytest.mark.parametrize(("base", "changes", "key", "right"), [
    (PAPERS, {"x2_star": 3.145}, "x2_star", "3.14416 m3"),
    (PAPERS, {"z_cap": 34.5}, "z_cap", "34.4 m3"),
    # Eq. (2) for 300 m2 * 500 mm/h = 0.0417 m3/s: 3 m + (0.0417 / 0.0053)^2 m.
    (PAPERS, {"a_in": 300, "r_o": 0.025}, "z_o", "64.68 m"),
    (PAPERS, {"c_hat": 15.25}, "c_hat", "above d - z_pump - z_H = 15.25 m"),
    (PAPERS, {"tau": 1.0000000001}, "tau", "a whole number of nanoseconds"),
    (PAPERS, {"z_veg": 0.5, "x2_star": 34.4}, "z_veg", "below z_cap / a2 = 0.5 m"),
    (PAPERS, {"monthly_evapotranspiration": [3.0] * 11}, "monthly_evapotranspiration", "twelve"),
    (PAPERS, {"elevation": ""}, "elevation", "must have a value"),
    (ROOF, {"wilting_point": None}, "field_capacity", "wilting_point"),
    (ROOF, {"z_cap": 34.4}, "z_cap", "20.64 m3"),
    (ROOF, {"z_veg": 0.3, "x2_star": 20.64}, "z_veg", "0.3 m"),
    (ROOF, {"wilting_point": 0.1}, "wilting_point", "below z_veg / z_soil = 0.0914"),
    (MAINS, {"mains_level": 0.75}, "mains_level", "above z_pump + z_H = 0.75 m"),
    (LOW, {"low_outlet_level": 3.0}, "low_outlet_level", "above z_pump + z_H = 0.75 m, below"),
    (OWN, {"initial_roof": None}, "initial_cistern", "initial_roof"),
    (OWN, {"initial_cistern": 98.0}, "initial_cistern", "97.5 m3"),
    ({**ROOF, **OWN}, {"initial_roof": 21.0}, "initial_roof", "20.64 m3"),
    (ROOF, {"initial_layer": 5.5}, "initial_layer", "at most the volume of the drainage layer"),
    (CLOCK, {"time_zone": None}, "quiet_hours", "time_zone"),
    *((CLOCK, {"quiet_hours": f'["{hours}"]'}, "quiet_hours", "a list of intervals")
      for hours in ("22", "24:00-06:00", "06:00-06:00", '00:00-12:00", "12:00-24:00')),
    *((CLOCK, {"time_zone": zone}, "time_zone", "IANA") for zone in ("Toronto", "../secret")),
    # -05:00 never, -04:00 now; in names that begin with Etc/ the sign is reversed.
    *((CLOCK, {"time_zone": zone}, "time_zone", "UTC offset")
      for zone in ("America/Halifax", "Etc/GMT-5")),
])
def test_values_that_contradict_others(
    tmp_path: Path, base: dict[str, object], changes: dict[str, object], key: str, right: str
) -> None:
    """The error has file, line, key, and what would be right."""
    path = write(tmp_path, **{**base, **changes})
    keys = [text.partition(":")[0] for text in path.read_text().splitlines()]
    message = refusal(read_site, path)
    assert message.startswith(f"{path}, line {1 + keys.index(key)}: {key}")
    assert right in message


def test_what_follows_is_computed(tmp_path: Path) -> None:
    """To Table I's last digit; and with another area, from that area."""
    written = read_site(write(tmp_path))
    assert read_site(write(tmp_path, x2_star=None, z_cap=None)) == written
    larger = read_site(write(tmp_path, a2=120.0, x2_star=None, z_cap=None))
    assert (larger.x2_star, larger.z_cap) == pytest.approx((120 * 0.0457, 60.0), rel=1e-15)


def test_a_mistyped_key_has_a_suggestion(tmp_path: Path) -> None:
    assert "did you mean a2?" in refusal(read_site, write(tmp_path, a2=None, a3=68.8))


def test_a_site_that_extends_another(tmp_path: Path) -> None:
    """It has only what differs, and so may its base."""
    write(tmp_path)
    (tmp_path / "roof.yaml").write_text(
        "extends: my site.yaml\na2: 100.0  # m2\n   # measured\ninitial_layer: 0.0\n"
        "x2_star: 4.57\nz_cap: 50.0\n"
    )
    child = tmp_path / "more" / "child.yaml"
    child.parent.mkdir()
    child.write_text("# A larger one\nextends: ../roof.yaml\na1: 50.0\n")
    base, site = read_site(tmp_path / "my site.yaml"), read_site(child)
    assert site == replace(base, a1=50.0, a2=100.0, x2_star=4.57, z_cap=50.0)
    (tmp_path / "roof.yaml").write_text(
        'extends: my site.yaml\nquiet_hours: ["22:00-06:00"]\ntime_zone: Europe/Berlin\n'
        "utc_offset: 1\n"
    )
    child.write_text('extends: ../roof.yaml\nquiet_hours: ["20:00-21:00"]\n')
    night = replace(base, time_zone="Europe/Berlin", utc_offset=1.0, quiet_hours=("20:00-21:00",))
    assert read_site(child) == night
    # A site of this package needs no copy next to the file.
    child.write_text("extends: site_neubrandenburg.yaml\na1: 50.0\n")
    measured = read_site(shared_directory() / "config" / "site_neubrandenburg.yaml")
    assert read_site(child) == replace(measured, a1=50.0)


@pytest.mark.parametrize(("changes", "volumes"), [
    # The valve site starts with 5 m3 and with its target of 39 mm on 68.8 m2.
    ({}, (5.0, 2.6832)), ({"cistern_volume": 3}, (3.9, 2.6832)),  # 1.3 times 3 m3
    ({"roof_area": 30}, (5.0, 30 * 0.108 * 0.63)),  # of which 63 % can be water
    ({"substrate_depth": 0.05, "z_veg": 0.017}, (5.0, 68.8 * 0.05 * 0.63)),
])
def test_inherited_volumes_are_no_more_than_what_fits(
    changes: dict[str, float], volumes: tuple[float, float], tmp_path: Path
) -> None:
    """A smaller cistern or roof than that of the file that it extends starts full."""
    lines = [f"{key}: {value}\n" for key, value in changes.items()]
    (tmp_path / "own.yaml").write_text(f"extends: site_valve.yaml\n{''.join(lines)}")
    site = read_site(tmp_path / "own.yaml")
    assert (site.initial_cistern, site.initial_roof) == pytest.approx(volumes, rel=1e-8)
    if "substrate_depth" in changes:  # in Python
        assert read_site(
            shared_directory() / "config" / "site_valve.yaml", changes
        ).initial_roof == site.initial_roof


def test_a_site_is_written_as_a_complete_file(tmp_path: Path) -> None:
    """What is read again is the same; volumes follow changed values; a note replaces a meaning."""
    written = tmp_path / "whole.yaml"
    changes = {
        "a2": 100 / 3, "quiet_hours": ["20:00-21:00"], "time_zone": "America/Toronto",
        "initial_cistern": 5.78e-5, "initial_roof": 1.0,
    }
    site = read_site(shared_directory() / "config" / "site_neubrandenburg.yaml", changes)
    assert site.x2_star == pytest.approx(100 / 3 * site.z_veg)
    text = format_site(site, {"a2": "as built"})
    written.write_text(text)
    assert read_site(written) == site
    lines = {line.partition(":")[0]: line for line in text.splitlines()}
    assert lines["a2"].endswith("# m2      as built")
    assert lines["a1"].endswith("# m2      area of the cistern's base")


def test_what_cannot_be_extended(tmp_path: Path) -> None:
    """Itself, a circle, a missing file; an error in a base has the name of that file."""
    child = tmp_path / "child.yaml"
    write(tmp_path, "a3: 5.0").rename(tmp_path / "base.yaml")
    (tmp_path / "circle.yaml").write_text("extends: child.yaml\n")
    for base, file, line, key in (
        ("child.yaml", "child.yaml", 1, "extends"), ("3", "child.yaml", 1, "extends"),
        ("absent.yaml", "child.yaml", 1, "extends"), ("circle.yaml", "circle.yaml", 1, "extends"),
        ("base.yaml", "base.yaml", len(TABLE_I) + 1, "a3"),
    ):
        child.write_text(f"extends: {base}\na1: 3.0\n")
        assert refusal(read_site, child).startswith(f"{tmp_path / file}, line {line}: {key} = ")


def test_a_run_and_a_study_keep_the_whole_site(tmp_path: Path) -> None:
    """In another directory the base file is not next to it."""
    file = tmp_path / "mine.yaml"
    file.write_text("extends: site_catchment.yaml\na1: 50.0\ninitial_cistern: 42.5\n")
    run = paper_run("--controller", "onoff", "--hours", "1", "--site", str(file))
    directory = make_run_directory(tmp_path / "run", "onoff")
    write_configuration(directory, run, {})
    assert read_site(directory / "configuration" / "site.yaml") == read_site(file)
    text = GRID.replace(str(shared_directory() / "config" / "site.yaml"), "mine.yaml")
    (carried,) = {case.site for case in cases_of(tmp_path / grid(tmp_path, text))}
    assert carried == read_site(file)
