"""Rejection of sites that a live site cannot serve: with an outlet valve, or without a pump."""

from __future__ import annotations

from pathlib import Path

from greenroof_ros.base.command_line import refuse
from greenroof_ros.site.site import Site


def refuse_valve(site: Site, file: Path | None) -> None:
    """Reject a site with a valve at its low outlet, or without a pump.

    Raises:
        ConfigurationError: if the site has a valve at its low outlet, or is not irrigated.
    """
    refuse(
        (not site.irrigated, f"{file}: irrigation", site.irrigation,
         "must be left out: a live site runs a pump, and this site has none"),
        (site.low_outlet_valve, f"{file}: low_outlet_valve", True,
         "must be false: a live site cannot command the valve yet, so the valve would not move "
         "although the controller's plan relies on it"),
    )
