"""The inputs of a run in Python: sites and keyword arguments."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

from greenroof_ros.api.control import FunctionController
from greenroof_ros.base.files import default_site_file
from greenroof_ros.controllers.registry import ControllerChoice, choose_class
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.simulation.run import Run
from greenroof_ros.site import file as site_file
from greenroof_ros.site.site import Site
from greenroof_ros.weather.series import Weather

PathText: TypeAlias = "str | os.PathLike[str]"

_NOT_THE_USERS = {__name__.partition(".")[0], "gymnasium"}


def read_site(path: PathText | None = None, **changes: Any) -> Site:
    """Read a site file, or the paper's site if no file is given.

    Volumes that depend on changed values are recomputed, such as the target volume ``x2_star`` if
    the target level ``z_veg`` changes.

    Args:
        path: path of the file; None for the paper's site.
        changes: values that replace those in the file, each under the name of a parameter or of a
            key that the file itself uses, such as ``cistern_volume`` and ``roof_area``.

    Raises:
        ConfigurationError: if the file or a value is invalid.

    Example:
        >>> import greenroof_ros as gr
        >>> site = gr.read_site(z_veg=0.04)
        >>> round(site.x2_star, 3), site.a2
        (2.752, 68.8)
    """
    return site_file.read_site(default_site_file() if path is None else Path(path), changes)


def read_weather(inputs: Mapping[str, Any]) -> Weather:
    """Read the weather of a run from the keyword arguments.

    Raises:
        ConfigurationError: if an input is invalid.
    """
    known = make_inputs(choose_class(FunctionController), inputs)
    return known.read_records(known.read_site())[0]


def build_run(
    controller: ControllerChoice, inputs: Mapping[str, Any], warned: set[str]
) -> Run:
    """Build and check a run from keyword arguments, and issue its notes as warnings.

    Args:
        controller: controller of the run.
        inputs: keyword arguments of the run.
        warned: warnings that have already been issued and are not repeated; new warnings are added.

    Raises:
        ConfigurationError: if an input is invalid.
    """
    run = make_inputs(controller, inputs).build()
    for note in (*run.notes(), *run.weather_notes()):
        if note not in warned:
            warned.add(note)
            warnings.warn(note, stacklevel=_count_own_calls())
    return run


def _count_own_calls() -> int:
    """Return the number of stack frames up to the first outside this package and Gymnasium."""
    frame, count = sys._getframe(1), 1
    while frame.f_back is not None and (
        frame.f_globals.get("__name__", "").partition(".")[0] in _NOT_THE_USERS
    ):
        frame, count = frame.f_back, count + 1
    return count
