"""Rejection of sites that a live site cannot serve: with an outlet valve, or without a pump."""

from __future__ import annotations

from pathlib import Path

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.site.site import Site


def refuse_valve(site: Site, file: Path | None) -> None:
    """Reject a site with a valve at its low outlet, or without a pump.

    Args:
        site: the site.
        file: the site file; None if the site was not read from a file.

    Raises:
        ConfigurationError: if the site has a valve at its low outlet, or is not irrigated.
    """
    if not site.irrigated:
        raise ConfigurationError(
            "must be left out: a live site runs a pump, and this site has none", file=file,
            key="irrigation", value=site.irrigation,
        )
    if site.low_outlet_valve:
        raise ConfigurationError(
            "must be false: a live site cannot command the valve yet, so the valve would not "
            "move although the controller's plan relies on "
            "it", file=file, key="low_outlet_valve", value=True,
        )
