"""Which forecasts a run's controller is given."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from greenroof_ros.forecast.skill import REAL, SKILLS
from greenroof_ros.model.look_ahead import MOST_MEMBERS

PERFECT = "perfect"
FILE = "file"

# Each model and those of OPTIONS that it has; a file is named by its path.
MODELS: dict[str, tuple[str, ...]] = {
    PERFECT: (),
    "persistence": (),
    "errors": ("skill", "seed"),
    "ensemble": ("skill", "seed", "members"),
}

# What the errors of a forecast are made from.
OPTIONS = ("skill", "seed", "members")

# Ranges of those that are whole numbers.
WHOLE = {"seed": (0, 2**31 - 1), "members": (1, MOST_MEMBERS)}


@dataclass(frozen=True)
class ForecastChoice:
    """Which forecasts a run's controller is given.

    Attributes:
        model: one of :data:`MODELS`, or ``file``.
        skill: one of :data:`greenroof_ros.forecast.skill.SKILLS`, or the path of a file such as
            ``config/forecasts/skill.yaml``.
        seed: of the errors.
        members: of the ensemble.
        file: with the forecasts; None where there is none.
    """

    model: str = PERFECT
    skill: str = REAL
    seed: int = 0
    members: int = 10
    file: Path | None = None

    def __str__(self) -> str:
        """The model's name or the file's path, as the option ``--forecast`` has it."""
        return self.model if self.file is None else str(self.file)

    @property
    def skill_file(self) -> Path | None:
        """The file of the skill; None where it has a name."""
        return None if self.skill in SKILLS else Path(self.skill)

    def options(self) -> dict[str, str | int]:
        """Return those of :data:`OPTIONS` that the model has, with their values."""
        return {name: getattr(self, name) for name in MODELS.get(self.model, ())}


def check_skill(text: str) -> None:
    """Check a skill's name, or the path of its file.

    Raises:
        ValueError: it is neither; the message says what it must be.
    """
    if text not in SKILLS and not text.lower().endswith(".yaml"):
        raise ValueError(f"must be one of {', '.join(SKILLS)}, or a FILE.yaml")


def choose(text: str) -> ForecastChoice:
    """Return the choice of a model by its name, or of a file by its path.

    Raises:
        ValueError: it is neither; the message says what it must be.
    """
    if text.lower().endswith(".csv"):
        return ForecastChoice(FILE, file=Path(text))
    if text not in MODELS:
        raise ValueError(f"must be one of {', '.join(MODELS)}, or a FILE.csv")
    return ForecastChoice(text)
