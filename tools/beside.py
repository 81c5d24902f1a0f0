"""Compare the speed of two checkouts, in turn within one run: ``python tools/beside.py DIR``.

DIR is another checkout, such as that of an older commit (``git worktree add DIR COMMIT``). Times
are processor times (s), without those that the same task takes for little work: to read files, for
example. Nothing is compiled or imported in them.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
from pathlib import Path

import paths
from markdown_tables import head, row

ROUNDS = 3
RECORD = paths.CHECKOUT / "config" / "weather" / "toronto_2021.csv"
MEASURE = """
import sys, time, warnings
warnings.simplefilter("ignore")
task(LITTLE)
times = [time.process_time()]
for amount in (LITTLE, MUCH):
    task(amount)
    times.append(time.process_time())
print(times[2] - 2 * times[1] + times[0])
"""
SEASON = f"""
import greenroof_ros as gr
def task(hours):
    site = gr.read_site("config/site_valve.yaml", tau=60.0, M=1)
    gr.simulate("onoff", site=site, hours=hours, weather="{RECORD}", start="2021-05-01T00:00",
                gaps="fill", trajectory_every=1e6)
"""
DISTRICT = f"""
import tempfile
from pathlib import Path
import greenroof_ros as gr
folder, own = Path("config/districts").resolve(), Path(tempfile.mkdtemp()) / "district.yaml"
example = (folder / "example.yaml").read_text().replace("house.yaml", f"{{folder}}/house.yaml")
def task(hours):
    period = f'file: "{RECORD}", start: 2021-05-01T00:00, hours: {{hours}}'
    text = example.replace("file: toronto_2014-2025.csv.gz", period).replace(", plan]", "]")
    own.write_text(text.replace("draws: 5", "draws: 1").replace("tau: 300", "tau: 60"))
    gr.district(own)
"""
ROOFS = """
import gymnasium, greenroof_ros
try:
    import greenroof_ros.gym
    name, ways = "greenroof_ros.gym:GreenRoofVector-v1", {}
except ImportError:  # an older checkout
    name, ways = "greenroof_ros:GreenRoof-v1", {"vectorization_mode": "sync"}
def task(steps):
    roofs = gymnasium.make_vec(name, num_envs=100, hours=12, decision_ticks=900, **ways)
    roofs.reset(seed=1)
    for _ in range(steps):
        roofs.step(roofs.action_space.sample())
"""
TASKS = {  # with amounts of little and of much work
    "season of a house: on/off, valve, 240,000 ticks of a minute": (SEASON, 400, 4400),
    "40 houses: three outlets, 60,000 ticks of a minute": (DISTRICT, 24, 1024),
    "100 environments: 1.35 million ticks of a second": (ROOFS, 1, 16),
}


def processor_s(checkout: Path, code: str, little: int, much: int) -> float:
    """Return the processor time of a task in a checkout (s)."""
    measure = MEASURE.replace("LITTLE", str(little)).replace("MUCH", str(much))
    ended = subprocess.run(
        [sys.executable, "-c", code + measure], cwd=checkout, check=True, capture_output=True,
        env={**os.environ, "PYTHONPATH": str(checkout)}, text=True,
    )
    return float(ended.stdout.splitlines()[-1])


def main() -> None:
    """Measure in rounds, and print the medians and their ratio."""
    checkouts = paths.CHECKOUT, Path(sys.argv[1]).resolve()
    print(head(["processor time (s)", "here", "there", "there / here"]), flush=True)
    for name, task in TASKS.items():
        times = [[processor_s(place, *task) for place in checkouts] for _ in range(ROUNDS)]
        here, there = map(statistics.median, zip(*times, strict=True))
        print(row([name, f"{here:.3f}", f"{there:.3f}", f"{there / here:.1f}"]), flush=True)


if __name__ == "__main__":
    main()
