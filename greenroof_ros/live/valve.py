"""A live site cannot command the valve of a low outlet yet."""

from __future__ import annotations

from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.site import Site


def refuse_valve(site: Site, file: Path | None) -> None:
    """Refuse a site with a valve on its low outlet.

    Args:
        site: the site.
        file: its file; None if it is not from a file.

    Raises:
        ConfigurationError: it has such a valve.
    """
    if site.low_outlet_valve:
        raise ConfigurationError(
            "must be false: a live site cannot command the valve yet; it would stay as it is while "
            "the controller plans with it", file=file, key="low_outlet_valve", value=True,
        )
