"""Registration of the environments for Gymnasium: ``GreenRoof-v1`` and ``GreenRoofVector-v1``.

Gymnasium calls :func:`register_environments` when it is imported, by the entry point
``gymnasium.envs``. Where the package is not installed, ``greenroof_ros.gym:GreenRoof-v1`` makes
Gymnasium import this module.
"""

from greenroof_ros.base.errors import require_extra

with require_extra("gym"):
    from gymnasium.envs.registration import register, registry

_API = "greenroof_ros.analysis.api"


def register_environments() -> None:
    """Register the environments, unless that has been done."""
    if "GreenRoof-v1" not in registry:
        register("GreenRoof-v1", f"{_API}.gym:GreenRoofEnv")
        register("GreenRoofVector-v1", vector_entry_point=f"{_API}.vector:GreenRoofVectorEnv")


register_environments()
