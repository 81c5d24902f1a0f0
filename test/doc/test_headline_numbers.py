"""The headline numbers of README and results agree with their figure, and with its file."""

from __future__ import annotations

import sys

from places import CHECKOUT
from real_seasons.inputs import ROOFS

sys.path.append(str(CHECKOUT / "doc"))

import worth
from real_season_tables import OVER_NO_RAIN, TOGETHER, Number, numbers

README = " ".join((CHECKOUT / "README.md").read_text().split())
RESULTS = " ".join((CHECKOUT / "doc" / "results.md").read_text().split())
PLACES = ("measured", "paper")


def test_readme_says_what_its_figure_shows() -> None:
    """The figure and the README's percentages come from the same stored file."""
    assert (CHECKOUT / "doc" / "_static" / "worth.svg").read_text() == worth.drawing()
    (target,) = {ROOFS[roof].target for roof in PLACES}
    assert f"from its target of {1000 * target:.1f} mm, in mm" in README
    shares = [100 * row.share.value for roof in PLACES for row in worth.rows(roof)]
    _, none, issued, perfect, _, *paper = shares
    assert (
        f"Measured roof: lookahead without a forecast {none:.0f}, with issued forecasts "
        f"{issued:.0f}, perfect {perfect:.0f}. "
        f"The paper's roof: {', '.join(f'{share:.0f}' for share in paper)}."
    ) in README
    assert f"without a forecast, 2024 | {100 - none:.0f} % | {100 - paper[0]:.0f} % |" in README


def test_readme_says_what_forecasts_add() -> None:
    """Over no forecast, with intervals: May to October, three services as one; and perfect ones."""
    issued = " | ".join(gain(numbers()[roof, TOGETHER, OVER_NO_RAIN]) for roof in PLACES)
    assert f"| from there, by issued forecasts | {issued} |" in README
    perfect = (100 * (1 - numbers()[roof, "perfect", OVER_NO_RAIN].value) for roof in PLACES)
    said = " and ".join(f"{less:.0f}" for less in perfect)
    assert f"Perfect forecasts reduced it by {said} % in 2024" in README


def test_readme_says_what_the_target_is_worth() -> None:
    """Less water at the site's own target, and less with perfect forecasts at the paper's."""
    pumped, lower, perfect = (
        numbers()[roof, forecast, "pumped (m³)"].value for roof, forecast in (
            ("measured", "on/off"), ("measured, target 39 mm", "on/off"), ("measured", "perfect"),
        )
    )
    assert (
        f"At 39 mm instead of 45.7 mm, on/off pumps {100 * (1 - lower / pumped):.0f} % less water "
        f"onto the measured roof; even perfect forecasts save {100 * (1 - perfect / pumped):.0f} %."
    ) in README


def test_results_say_what_forecasts_and_target_are_worth() -> None:
    """The sentences above the tables have the numbers of the tables."""
    roofs = ("measured", "measured, target 39 mm", "paper")
    measured, own, paper = (numbers()[roof, TOGETHER, OVER_NO_RAIN] for roof in roofs)
    assert f"{gain(measured).replace('(', 'less (')} than with a forecast of no rain" in RESULTS
    assert f"{gain(own)} less at its own target of 39 mm" in RESULTS
    assert f"{gain(paper)} less on the paper's roof" in RESULTS
    pumped, lower, perfect = (
        numbers()[roof, forecast, "pumped (m³)"].value
        for roof, forecast in ((roofs[0], "on/off"), (roofs[1], "on/off"), (roofs[0], "perfect"))
    )
    saved = f"{100 * (1 - lower / pumped):.0f} % less than at 45.7 mm: {pumped - lower:.1f} m³"
    assert f"At 39 mm on/off pumped {saved}" in RESULTS
    assert f"`lookahead` pumped {100 * (1 - perfect / pumped):.0f} % less than on/off" in RESULTS


def gain(ratio: Number) -> str:
    """Return how much less a ratio with its interval is than 1, such as ``3 % (-1 to 13 %)``."""
    value, low, high = (100 * (1 - number) for number in ratio)
    return f"{value:.0f} % ({high:.0f} to {low:.0f} %)"
