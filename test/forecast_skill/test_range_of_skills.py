"""Skill real over days, as a roof adds up rain, and the end of the range of skills: none."""

from __future__ import annotations

import numpy as np
import pytest
from forecast_skill.agreement import of_members, of_services
from forecast_skill.figures import days_ahead, seasons, services

from greenroof_ros.forecast.skill import read_skill

YEARS = (2015, 2017, 2021, 2023)
DAYS = (2, 5)


@pytest.fixture(scope="module")
def rain() -> dict[int, np.ndarray]:
    """Four seasons of Toronto (mm)."""
    return {year: season for year, season in seasons().items() if year in YEARS}


def ahead(rain: dict[int, np.ndarray], skill: str, days: tuple[int, ...]) -> dict[int, np.ndarray]:
    """Return what two members forecast of all hours (mm) so many days ahead."""
    found = [days_ahead(year, one, read_skill(skill), 1, days, 2) for year, one in rain.items()]
    return {day: np.concatenate([each[day] for each in found], axis=1) for day in days}


def test_long_sums_are_no_better_known_than_services_know_them(
    rain: dict[int, np.ndarray],
) -> None:
    """Sums over 72 and 120 h: two members agree about as well as two services.

    Services agree to r of 0.72 to 0.89, which needs no gauge. If members of ``real`` agreed better,
    its sums over days would be too well known, since it takes what comes for one more member. They
    agree less: by 0.2 at most in so few seasons. Both know sums of days better than half days.
    """
    observed = np.concatenate(list(rain.values()))
    members = ahead(rain, "real", DAYS)
    for day in DAYS:
        short = of_members(members[day], observed, 12, 2).pairs.mean()
        for hours in (72, 120):
            services = of_services(day, hours).pairs
            pair = of_members(members[day], observed, hours, 2).pairs.mean()
            assert services.min() - 0.2 < pair < services.max()
            assert pair > short - 0.05
            assert services.mean() > of_services(day, 12).pairs.mean()


def test_none_knows_nothing_and_is_as_wet_as_services(rain: dict[int, np.ndarray]) -> None:
    """A day ahead r is that of chance; it rains as often as in the climate, and no less."""
    observed = np.concatenate(list(rain.values()))
    members = ahead(rain, "none", (1,))[1]
    for hours in (12, 120):
        found = of_members(members, observed, hours, 1)
        assert found.mean == pytest.approx(0.0, abs=4 / np.sqrt(len(observed) / hours))
    there = members[~np.isnan(members)]
    assert (there > 0).mean() == pytest.approx(read_skill("none").climate.wet_share, rel=0.1)
    biases = np.concatenate([each[:, 3] for each in services().values()])
    assert biases.min() < there.mean() / observed.mean() < biases.max() + 0.1


def test_none_is_sure_of_nothing_from_the_next_hour_on() -> None:
    """Coherence 1 at the present, 0 an hour ahead, at all frequencies."""
    coherence = read_skill("none").coherence(np.array([0.0, 1.0, 240.0]), np.array([0.0, 0.5]))
    assert coherence.tolist() == [[1.0, 1.0], [0.0, 0.0], [0.0, 0.0]]
