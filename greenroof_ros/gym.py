"""Registration of the environments for Gymnasium, which imports this module for its names.

The names are ``greenroof_ros.gym:GreenRoof-v1`` and ``greenroof_ros.gym:GreenRoofVector-v1``.
"""

from greenroof_ros.base.errors import require_extra

with require_extra("gym"):
    import gymnasium

_API = "greenroof_ros.api"

gymnasium.register("GreenRoof-v1", f"{_API}.gym:GreenRoofEnv")
gymnasium.register("GreenRoofVector-v1", vector_entry_point=f"{_API}.gym:GreenRoofVectorEnv")
