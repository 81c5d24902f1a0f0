"""The headline numbers of the README agree with its figure."""

from __future__ import annotations

import sys

from places import CHECKOUT
from real_seasons.inputs import ROOFS

sys.path.append(str(CHECKOUT / "doc"))

import worth
from real_season_tables import ALL, DRESSED, ISSUED, SEASON, Number, numbers


def test_readme_says_what_its_figure_shows() -> None:
    """The figure and the README's percentages come from the same stored file."""
    assert (CHECKOUT / "doc" / "_static" / "worth.svg").read_text() == worth.drawing()
    rows = [row for roof in ("measured", "paper") for row in worth.rows(roof)]
    readme = " ".join((CHECKOUT / "README.md").read_text().split())
    (target,) = {ROOFS[roof].target for roof in ("measured", "paper")}
    assert f"from its target of {1000 * target:.1f} mm, in mm" in readme
    shares = [100 * row.share.value for row in rows]
    _, none, issued, dressed, perfect, plan, _, *paper = shares
    low = rows[5].share.low
    assert low is not None
    bound = 100 * low
    assert (
        f"Measured roof: lookahead without a forecast {none:.0f}, with issued forecasts "
        f"{issued:.0f}, dressed {dressed:.0f}, perfect {perfect:.0f}, least possible {bound:.0f} "
        f"to {plan:.0f}. The paper's roof: {', '.join(f'{share:.0f}' for share in paper)}."
    ) in readme
    assert f"without a forecast | {100 - none:.0f} % | {100 - paper[0]:.0f} % |" in readme


def test_readme_says_what_forecasts_add() -> None:
    """Over no forecast, with intervals: May to October, three services as one."""
    issued, dressed = (
        " | ".join(
            gain(numbers()[roof, SEASON, ALL, "three", form, "over no rain"])
            for roof in ("measured", "paper")
        )
        for form in (ISSUED, DRESSED)
    )
    readme = " ".join((CHECKOUT / "README.md").read_text().split())
    assert f"| from there, by issued forecasts | {issued} |" in readme
    assert f"corrected by the rain of other weeks | {dressed} |" in readme


def gain(ratio: Number) -> str:
    """Return how much less a ratio with its interval is than 1, such as ``3 % (-1 to 13 %)``."""
    assert ratio.low is not None and ratio.high is not None
    value, low, high = (100 * (1 - number) for number in (ratio.value, ratio.low, ratio.high))
    return f"{value:.0f} % ({high:.0f} to {low:.0f} %)"
