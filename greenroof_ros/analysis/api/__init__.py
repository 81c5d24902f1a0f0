"""The Python interface, ``import greenroof_ros as gr``: simulations, charts, environments."""

from greenroof_ros.common.errors import in_extra

GYMNASIUM_ID = "GreenRoof-v0"


def register_in_gymnasium() -> None:
    """Add the environment to Gymnasium's registry, once; it is imported when it is made.

    Gymnasium before 1.0 calls this while it is imported itself.
    """
    with in_extra("gym"):
        from gymnasium.envs.registration import register, registry

    if GYMNASIUM_ID not in registry:
        register(GYMNASIUM_ID, f"{__name__}.gym:GreenRoofEnv")
