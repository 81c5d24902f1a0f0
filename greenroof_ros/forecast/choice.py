"""The choice of the forecasts that a run's controller receives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from greenroof_ros.base.errors import ConfigurationError, describe_choices, rename_keys
from greenroof_ros.base.files import find_shipped
from greenroof_ros.base.parameter import entry, make_record, parameters_of
from greenroof_ros.forecast.issue import SERVICE_DELAY_H, SUFFIXES
from greenroof_ros.forecast.skill import REAL, SKILLS
from greenroof_ros.site.horizon import MAX_MEMBERS

MODELS = PERFECT, ERRORS, ENSEMBLE = "perfect", "errors", "ensemble"
"""the models; an archive is named by its path"""
FILE = "file"
# The models that have an option, by its name.
_MODELS_WITH = {
    "skill": (ERRORS, ENSEMBLE), "seed": (ERRORS, ENSEMBLE), "members": (ENSEMBLE,),
    "delay": (ERRORS, ENSEMBLE, FILE),
}


@dataclass(frozen=True)
class ForecastChoice:
    """The choice of the forecasts that a run's controller receives.

    Attributes:
        model: one of :data:`MODELS`, or ``file``.
        file: forecast file, or directory of forecast files; None for a model.
        skill: one of :data:`greenroof_ros.forecast.skill.SKILLS`.
        seed: random seed of the forecast errors.
        members: number of members of the ensemble.
        delay: time from the nominal time of a forecast until the forecast is available (h); None
            for the usual delay of the file format or, with errors, of weather services.
    """

    model: str = PERFECT
    file: Path | None = None
    skill: str = entry(
        "skill of errors and ensemble: real for that of a weather service, none for rain at random "
        "times", choices=SKILLS, default=REAL,
    )
    seed: int = entry(
        "random seed of errors and ensemble", 0, 2**31 - 1, default=0,
    )
    members: int = entry("number of members of an ensemble", 1, MAX_MEMBERS, default=10)
    delay: float | None = entry(
        "time from the nominal time of a forecast until it is available; by default "
        f"{SERVICE_DELAY_H:g} h, but for a file in this project's format the time that it states, "
        "or 0", 0.0, 48.0, unit="h", default=None,
    )

    def __str__(self) -> str:
        """Return the name of the model or the path of the file, as in the option ``--forecast``."""
        return self.model if self.file is None else str(self.file)

    def options(self) -> dict[str, str | float]:
        """Return those :data:`OPTIONS` of the model that are set, each with its value."""
        own = [name for name, models in _MODELS_WITH.items() if self.model in models]
        values = {name: getattr(self, name) for name in own}
        return {name: value for name, value in values.items() if value is not None}


OPTIONS = {parameter.name: parameter for parameter in parameters_of(ForecastChoice)}
"""the options of forecasts, by name"""
INPUTS = {
    f"forecast_{name}": replace(parameter, name=f"forecast_{name}")
    for name, parameter in OPTIONS.items()
}
"""the same, by the names of a run's inputs"""


def choose(text: str, options: Mapping[str, Any] | None = None) -> ForecastChoice:
    """Return the choice of a model by its name, or of an archive by its path.

    Args:
        text: the input ``forecast`` of a run.
        options: values of :data:`OPTIONS`.

    Raises:
        ConfigurationError: if there is no such model, or if the model has no such option or value;
            the error's key is ``forecast``, or one of :data:`INPUTS`.
    """
    model, options = text if text in MODELS else FILE, options or {}
    if model == FILE and not (
        text.lower().endswith((*SUFFIXES, "/")) or (text and Path(text).is_dir())
    ):
        files = f", or forecasts: a file ({', '.join(SUFFIXES)}) or a directory of files"
        raise ConfigurationError(describe_choices(MODELS, text, files), key="forecast", value=text)
    with rename_keys({name: f"forecast_{name}" for name in OPTIONS}):
        checked = make_record(ForecastChoice, options)
        for name, value in options.items():
            if model not in _MODELS_WITH[name]:
                owners = " and ".join(_MODELS_WITH[name])
                raise ConfigurationError(f"is an option of {owners}", key=name, value=value)
    return replace(checked, model=model, file=find_shipped(Path(text)) if model == FILE else None)
