"""Rejection of sites with an outlet valve, which a live site cannot command yet."""

from __future__ import annotations

from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.site.site import Site


def refuse_valve(site: Site, file: Path | None) -> None:
    """Reject a site with a valve at its low outlet.

    Args:
        site: the site.
        file: the site file; None if the site was not read from a file.

    Raises:
        ConfigurationError: if the site has a valve at its low outlet.
    """
    if site.low_outlet_valve:
        raise ConfigurationError(
            "must be false: a live site cannot command the valve yet, so the valve would not "
            "move although the controller's plan relies on "
            "it", file=file, key="low_outlet_valve", value=True,
        )
