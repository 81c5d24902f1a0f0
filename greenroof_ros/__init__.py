"""Watering of a green roof from a rainwater cistern, simulated without ROS or as a ROS 2 graph.

The names in ``__all__``, and the version, are loaded on first use, so that the import is fast.
"""

from __future__ import annotations

TYPE_CHECKING = False  # typing's, whose import takes longer than all else here
if TYPE_CHECKING:
    from typing import Any

    from greenroof_ros.analysis.calibration.result import calibrate
    from greenroof_ros.analysis.district.result import district
    from greenroof_ros.analysis.sizing.run import size
    from greenroof_ros.analysis.storms import design_storm, storms
    from greenroof_ros.analysis.study import study
    from greenroof_ros.analysis.verification import verify
    from greenroof_ros.api.environment import Environment
    from greenroof_ros.api.scenarios import scenarios, score
    from greenroof_ros.api.simulate import Result, compare, read_bag, read_site, simulate
    from greenroof_ros.base.errors import ConfigurationError
    from greenroof_ros.base.parameter import Parameter
    from greenroof_ros.base.versions import __version__ as __version__
    from greenroof_ros.controllers.decide import ControllerError

__all__ = [
    "ConfigurationError", "ControllerError", "Environment", "Parameter", "Result", "calibrate",
    "compare", "design_storm", "district", "read_bag", "read_site", "scenarios", "score",
    "simulate", "size", "storms", "study", "verify",
]

# The module of each of these names.
_MODULES = {
    "ConfigurationError": "base.errors", "ControllerError": "controllers.decide",
    "Environment": "api.environment", "Parameter": "base.parameter", "Result": "api.simulate",
    "calibrate": "analysis.calibration.result", "compare": "api.simulate",
    "design_storm": "analysis.storms", "district": "analysis.district.result",
    "read_bag": "api.simulate", "read_site": "api.simulate",
    "scenarios": "api.scenarios", "score": "api.scenarios", "simulate": "api.simulate",
    "size": "analysis.sizing.run", "storms": "analysis.storms", "study": "analysis.study",
    "verify": "analysis.verification", "__version__": "base.versions",
}


if not TYPE_CHECKING:  # or every name would be right

    def __getattr__(name: str) -> Any:
        """Load an object whose name is in ``_MODULES``."""
        import importlib

        if name in _MODULES:
            module = importlib.import_module(f"{__name__}.{_MODULES[name]}")
            return getattr(module, name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the names of all attributes, including the names that are loaded on first use."""
    return sorted({*globals(), *_MODULES})
