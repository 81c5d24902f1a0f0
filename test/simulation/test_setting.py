"""What a result states: site, weather and period, what may mislead, and the table at the end."""

from __future__ import annotations

import io
import os
import re
import shlex
import sys
import warnings
from itertools import accumulate
from pathlib import Path

import pytest
from commands import run_command
from paper import paper_run
from places import CHECKOUT, CONFIG
from rich.console import Console

import greenroof_ros as gr
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.bringup import simulated
from greenroof_ros.commands import simulate
from greenroof_ros.simulation import screen
from greenroof_ros.simulation.loop import Simulation
from greenroof_ros.simulation.loop import simulate as run_loop
from greenroof_ros.simulation.options import build_run
from greenroof_ros.simulation.run import note_pumps
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import format_place, measure_distance

HEADER = "time,precipitation [mm/h],published evapotranspiration [mm/day]\n"


@pytest.mark.parametrize("command", ["simulate", "bound"])
def test_a_site_in_berlin_does_not_run_torontos_weather_without_a_word(
    command: str, tmp_path: Path
) -> None:
    """Site, weather and period come first."""
    site = tmp_path / "berlin.yaml"
    site.write_text(f"extends: {CONFIG / 'site.yaml'}\nlatitude: 52.52\nlongitude: 13.41\n")
    done = run_command(
        command, "--hours", "0.5", "--site", str(site), cwd=tmp_path, env=dict(os.environ)
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    # 6480 km: an independent calculator of great circles gives 6475 to 6485, by its ellipsoid.
    away = re.match(r"note: \S*toronto_2021-07.csv is from 43.63 N, 79.40 W, (\d+) km from the "
                    r"site at 52.52 N, 13.41 E", lines[0])
    assert away is not None, lines[0]
    assert float(away[1]) == pytest.approx(6480, rel=0.005)
    for each in ("berlin.yaml", "toronto_2021-07.csv"):
        assert each in "".join(lines[1:8])


@pytest.mark.parametrize(("comment", "away"), [
    ("# latitude: 44.23, longitude: -76.50\n", 242.0),  # Kingston
    ("# Station X\n# longitude: -79.87\n# latitude: 43.26\n", None),  # Hamilton, 56 km
    ("# latitude: 43.68\n# longitude: -79.63\n", 0.0),  # the airport, 19 km
    ("# Toronto\n", 0.0),  # no place
    ("# latitude: 43.68\n", 0.0),
])
def test_the_place_of_a_weather_file_is_in_its_comments(
    comment: str, away: float | None, tmp_path: Path
) -> None:
    file = tmp_path / "w.csv"
    rows = "".join(f"2021-07-07T{hour:02}:00-05:00,0,1\n" for hour in range(24))
    file.write_text(comment + HEADER + rows)
    notes = paper_run("--weather", str(file), "--hours", "1").notes()
    assert len(notes) == (away != 0.0)
    if away:
        (found,) = re.findall(r"(\d+) km from the site", notes[0])
        assert float(found) == pytest.approx(away, rel=0.01)


def test_a_wrong_place_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "w.csv"
    file.write_text(f"#\n# latitude: 436, longitude: 7\n{HEADER}2021-07-07T00:00-05:00,0,1\n")
    with pytest.raises(ConfigurationError, match=r"w.csv, line 2: latitude.*-90 to 90 degrees"):
        paper_run("--weather", str(file))


@pytest.mark.parametrize(("here", "there", "distance"), [
    ((0.0, 0.0), (0.0, 180.0), 20015.0),  # half the circumference
    ((0.0, 179.5), (0.0, -179.5), 111.2),  # a degree across the date line
    ((89.0, 0.0), (89.0, 180.0), 222.4),  # two degrees across the pole
])
def test_distances(
    here: tuple[float, float], there: tuple[float, float], distance: float
) -> None:
    assert measure_distance(here, there) == pytest.approx(distance, rel=1e-3)
    assert format_place(-33.87, 151.21) == "33.87 S, 151.21 E"


def test_where_notes_are_seen() -> None:
    """In Python as a warning, and in the summary of a run.

    300 s of 8.32 l/s are 2.497 m3 of the target of 2.683 m3. But 1 l/s on 40 m2 moves 62 l in 62 s,
    less than a tenth of 40 m2 times 15.75 mm.
    """
    litre = {"pump_flow": 3600.0, "roof_area": 40.0, "z_veg": 0.01575}
    for tau, notes in ((62.0, 0), (64.0, 1)):
        papers = read_site(CONFIG / "site.yaml", {**litre, "tau": tau})
        assert len([*note_pumps(papers)]) == notes
    site = gr.read_site(CONFIG / "site_valve.yaml", tau=300.0)
    with pytest.warns(UserWarning, match="in a tick of 300 s the pumps can deliver 93%"):
        result = gr.simulate("onoff", site=site, hours=0.5)
    assert any("can deliver 93%" in note for note in result.summary["notes"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gr.simulate("onoff", hours=0.1)


def examples() -> list[str]:
    """Return the examples of README and help that need no other file, machine or node."""
    texts = [simulate.make_parser().epilog, simulated.make_parser().epilog]
    texts.append((CHECKOUT / "README.md").read_text())
    whole = "\n".join(map(str, texts)).replace("\\\n", " ")
    found = re.findall(r"greenroof ((?:run|simulate) [^#\n]*)", whole)
    alone = [line for line in found if not re.search(
        r"--(weather|site|drive|drive-at|ros-args) |external", line
    )]
    assert len(alone) >= 4
    return alone


@pytest.mark.parametrize("line", examples())
def test_the_pump_runs_in_the_examples(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    words = shlex.split(line)
    parser = {"run": simulated, "simulate": simulate}
    monkeypatch.setattr(sys, "argv", [f"greenroof {words[0]}", *words[1:]])
    arguments = parser[words[0]].make_parser().parse_args(words[1:])
    flows = (tick.flows.pump for tick in Simulation(build_run(arguments)).ticks())
    assert any(pumped_m3 > 0.1 for pumped_m3 in accumulate(flows))  # in ticks of a second


def test_no_raw_data() -> None:
    """No dictionary, list or None in any row, for a run in which everything happened."""
    run = paper_run(
        "--hours", "0.1", "--forecast", "ensemble", "--roof-noise", "0.001", "--pump-min-on", "60",
        "--weight", "0.01",
    )
    result = run_loop(run)[0] | {
        "solver": {"mean_s": 1e-5, "p99_s": 1e-5, "max_s": 1e-5, "solves": 9, "fallbacks": 1},
        "messages": {"/pump/flow": 361, "/clock": 361},
        "refused": {"/pump/flow": 37, "/roof/level": 2},
        "parameter_changes": [
            {"tick": 300, "parameter": "weight", "before": 0.001, "value": 0.01},
            {"tick": 301, "parameter": "most", "before": None, "value": 2.0},
        ],
        "parameter_change_count": 5,
        "excess_starts": 2, "limited_steps": 0, "frost_hours": 2.0,
        "weather_notes": ["rain was moved an hour back"],
    }
    stream = io.StringIO()
    Console(file=stream, width=200).print(screen.grid("Result", screen.rows(result)))
    text = stream.getvalue()
    assert not set("{}[]'").intersection(text) and "None" not in text
