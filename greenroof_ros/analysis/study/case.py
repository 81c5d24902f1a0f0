"""A case of a study: the inputs of a run with its files, and its description in the table."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any

from greenroof_ros.analysis.study.own_code import identify_code
from greenroof_ros.base.parameter import parameters_of
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.forecast.choice import OPTIONS, ForecastChoice
from greenroof_ros.physics.sensor_and_pump import SensorAndPump
from greenroof_ros.results.table import format_exactly
from greenroof_ros.simulation.inputs import RunInputs
from greenroof_ros.weather.series import REFUSE


@dataclass(frozen=True)
class InputFile:
    """An input file for runs; its content is sent to each worker once, not with every case."""

    name: str
    """name that is unique in the study"""
    content: bytes

    def __getstate__(self) -> dict[str, str]:
        """Return the state that a worker receives with a case, which is only the name."""
        return {"name": self.name}

    @cached_property
    def digest(self) -> str:
        """Digest of the content."""
        return hashlib.sha256(self.content).hexdigest()


@dataclass(frozen=True)
class Case:
    """One run of a study, with everything that affects its numbers.

    Attributes:
        inputs: complete inputs of the run, with values for everything that the grid leaves out.
        site: site file.
        weather: weather files, which are joined in chronological order.
        weather_name: common name of the weather files, unique in the study.
        forecast_file: file of forecasts; None for a model.
        bound_block: length of the time blocks that have one variable each when the minimum possible
            deviation is computed (s); 0 to compute no bound.
        ticks: number of ticks.
    """

    inputs: RunInputs
    site: InputFile
    weather: tuple[InputFile, ...]
    weather_name: str
    forecast_file: InputFile | None
    bound_block: float
    ticks: int

    @property
    def controller(self) -> str:
        """Name of the controller."""
        return self.inputs.controller.name

    @property
    def start(self) -> datetime:
        """Time of tick 0."""
        return datetime.fromisoformat(self.inputs.start)

    @property
    def hours(self) -> float:
        """Length of the run (h)."""
        return self.inputs.hours or 0.0

    @property
    def files(self) -> tuple[InputFile, ...]:
        """All input files."""
        return self.site, *self.weather, *filter(None, [self.forecast_file])

    @cached_property
    def identity(self) -> str:
        """Twelve hexadecimal digits that are always the same for equal cases, on any machine."""
        inputs = self.inputs
        content = {
            **self.columns(),
            **{each.name: getattr(inputs, each.name) for each in parameters_of(RunInputs)},
            **inputs.sensor_and_pump.values(),
            "site": self.site.digest,
            "weather": " ".join(file.digest for file in self.weather),
            "forecast_file": self.forecast_file.digest if self.forecast_file else "",
            "parameters": sorted(inputs.parameters.items()),
            "controller": [inputs.controller.reference, identify_code(inputs.controller)],
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:12]

    @property
    def bound_identity(self) -> str:
        """Identity of the inputs except those of the controller, followed by the time block."""
        return f"{self.plain.identity}-{format_exactly(self.bound_block)}"

    @property
    def discharge_bound_identity(self) -> str:
        """Identity of the controller-independent inputs; empty if there is no valve."""
        return self.plain.identity if "outlet" in self.inputs.parameters else ""

    @property
    def plain(self) -> Case:
        """The same case with on/off control, no forecast, and an ideal sensor and pump."""
        return replace(self, forecast_file=None, inputs=replace(
            self.inputs, controller=find_controller("onoff"), parameters={},
            forecast=ForecastChoice(), sensor_and_pump=SensorAndPump(),
        ))

    def columns(self) -> dict[str, Any]:
        """Return the columns of the table that describe the case.

        The columns do not include the parameters of the controller, the sensor and the pumps.
        """
        inputs = self.inputs
        return {
            "site": self.site.name,
            "weather": self.weather_name,
            "start": inputs.start,
            "hours": self.hours,
            "evapotranspiration": inputs.evapotranspiration,
            **({"gaps": inputs.gaps} if inputs.gaps != REFUSE else {}),
            "forecast": str(inputs.forecast),
            **{f"forecast_{name}": inputs.forecast.options().get(name) for name in OPTIONS},
            "controller": self.controller,
            "initial": inputs.initial,
            "cistern_m3": inputs.cistern,
            "roof_m3": inputs.roof,
        }

    def find_inputs(self, directory: Path) -> RunInputs:
        """Return the inputs, which refer to their files by the paths in a directory."""
        forecast = self.inputs.forecast
        if forecast.file is not None:
            forecast = replace(forecast, file=directory / forecast.file)
        return replace(
            self.inputs, site=directory / self.site.name,
            weather=tuple(directory / file.name for file in self.weather), forecast=forecast,
        )


def collect_contents(cases: Iterable[Case]) -> dict[str, bytes]:
    """Return the contents of all input files of some cases, by name."""
    return {file.name: file.content for case in cases for file in case.files}
