"""The headline numbers of the README are those of its figure."""

from __future__ import annotations

import csv
import re
import sys

from places import CHECKOUT

sys.path.append(str(CHECKOUT / "doc"))

import worth


def test_readme_says_what_its_figure_shows() -> None:
    """The figure and the README's percentages come from the same stored file."""
    assert (CHECKOUT / "doc" / "_static" / "worth.svg").read_text() == worth.drawing()
    with worth.FILE.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    readme = " ".join((CHECKOUT / "README.md").read_text().split())
    shares = [100 * float(row["share of on/off's"]) for row in rows]
    _, none, issued, dressed, perfect, plan, _, *paper = shares
    bound = 100 * float(rows[5]["its low end"])
    assert (
        f"Measured roof: lookahead without a forecast {none:.0f}, with issued forecasts "
        f"{issued:.0f}, dressed {dressed:.0f}, perfect {perfect:.0f}, least possible {bound:.0f} "
        f"to {plan:.0f}. The paper's roof: {', '.join(f'{share:.0f}' for share in paper)}."
    ) in readme
    assert f"without a forecast | {100 - none:.0f} % | {100 - paper[0]:.0f} % |" in readme


def test_readme_says_what_forecasts_add() -> None:
    """Over no forecast, with intervals: the tables of May to October, three services as one."""
    page = (CHECKOUT / "doc" / "reference" / "issued-forecasts.md").read_text()
    season = page.partition("## May to October, from a dry roof")[2].partition("\n### ")[0]
    rows = re.findall(r"^\| three \| (.*) \|$", season, re.MULTILINE)
    issued, dressed = zip(*(
        (gain(cells[1]), gain(cells[4])) for cells in (row.split(" | ") for row in rows)
    ), strict=True)
    readme = " ".join((CHECKOUT / "README.md").read_text().split())
    assert f"| from there, by issued forecasts | {' | '.join(issued)} |" in readme
    assert f"corrected by the rain of other weeks | {' | '.join(dressed)} |" in readme


def gain(ratio: str) -> str:
    """Return how much less a ratio with its interval is than 1, such as ``3 % (-1 to 13 %)``."""
    value, low, high = (100 * (1 - float(number)) for number in re.findall(r"\d\.\d+", ratio))
    return f"{value:.0f} % ({high:.0f} to {low:.0f} %)"
