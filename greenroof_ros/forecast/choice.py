"""The choice of the forecasts that a run's controller gets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError, describe_choices
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.forecast.skill import REAL, SKILLS
from greenroof_ros.formats.reading import SUFFIXES
from greenroof_ros.model.look_ahead import MAX_MEMBERS

PERFECT = "perfect"
FILE = "file"

# Each model and its OPTIONS; an archive is named by its path.
MODELS: dict[str, tuple[str, ...]] = {
    PERFECT: (),
    "persistence": (),
    "errors": ("skill", "seed", "delay"),
    "ensemble": ("skill", "seed", "members", "delay"),
}

_OPTIONS_OF = {**MODELS, FILE: ("delay",)}

NUMBERS = {
    "seed": Parameter(
        "forecast_seed", 0, "", 0, 2**31 - 1, "errors, ensemble: seed of the errors"
    ),
    "members": Parameter(
        "forecast_members", 10, "", 1, MAX_MEMBERS, "ensemble: number of its members"
    ),
    "delay": Parameter(
        "forecast_delay", -1.0, "h", 0.0, 48.0,
        "errors, ensemble, a file: time from an issue's nominal time until it is available",
    ),
}
"""the options that are numbers, by name; the delay has no default"""

OPTIONS = ("skill", *NUMBERS)


@dataclass(frozen=True)
class ForecastChoice:
    """The choice of the forecasts that a run's controller gets.

    Attributes:
        model: one of :data:`MODELS`, or ``file``.
        skill: one of :data:`greenroof_ros.forecast.skill.SKILLS`, or the path of a file such as
            ``config/forecasts/skill.yaml``.
        seed: of the errors.
        members: number of members of the ensemble.
        file: file of forecasts, or directory of such files; None for a model.
        delay: time after its nominal time from which an issue is known (h); None for the usual
            delay of the kind of file, or of weather services for a model with errors.
    """

    model: str = PERFECT
    skill: str = REAL
    seed: int = 0
    members: int = 10
    file: Path | None = None
    delay: float | None = None

    def __str__(self) -> str:
        """The model's name or the file's path, as in the option ``--forecast``."""
        return self.model if self.file is None else str(self.file)

    @property
    def skill_file(self) -> Path | None:
        """The file of the skill; None for a named skill."""
        return None if self.skill in SKILLS else Path(self.skill)

    @property
    def option_names(self) -> tuple[str, ...]:
        """The :data:`OPTIONS` that the model, or an archive, has."""
        return _OPTIONS_OF[self.model]

    def options(self) -> dict[str, str | float]:
        """Return the :data:`OPTIONS` of the model that are set, each with its value."""
        values = {name: getattr(self, name) for name in self.option_names}
        return {name: value for name, value in values.items() if value is not None}


def check_skill(text: str, key: str) -> None:
    """Check a skill's name, or the path of its file.

    Args:
        text: of an option or a file.
        key: which gives it, for messages.

    Raises:
        ConfigurationError: it is neither.
    """
    if text not in SKILLS and not text.lower().endswith(".yaml"):
        raise ConfigurationError(
            describe_choices(SKILLS, text, ", or a FILE.yaml"), key=key, value=text
        )


def choose(text: str, key: str) -> ForecastChoice:
    """Return the choice of a model by its name, or of an archive by its path.

    Args:
        text: of an option or a file.
        key: which gives it, for messages.

    Raises:
        ConfigurationError: it is neither.
    """
    if text in MODELS:
        return ForecastChoice(text)
    if text.lower().endswith((*SUFFIXES, "/")) or (text and Path(text).is_dir()):
        return ForecastChoice(FILE, file=Path(text))
    files = f", or forecasts: a file ({', '.join(SUFFIXES)}) or a directory of files"
    raise ConfigurationError(describe_choices(MODELS, text, files), key=key, value=text)
