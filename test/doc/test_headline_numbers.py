"""The headline numbers of the README are those of its figure."""

from __future__ import annotations

import sys

from places import CHECKOUT

sys.path.append(str(CHECKOUT / "doc"))

import worth


def test_readme_says_what_its_figure_shows() -> None:
    """The figure and the README's percentages come from the same stored file."""
    assert (CHECKOUT / "doc" / "_static" / "worth.svg").read_text() == worth.drawing()
    rows = [row for roof in ("measured", "paper") for row in worth.rows(roof)]
    readme = " ".join((CHECKOUT / "README.md").read_text().split())
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
    assert (
        f"deviates {100 - issued:.0f} % less on the measured roof and {100 - paper[1]:.0f} % less "
        "on the paper's;"
    ) in readme
    assert f"{100 - dressed:.0f} and {100 - paper[2]:.0f} %." in readme
