"""A target that a fitted roof can reach."""

from __future__ import annotations

from dataclasses import replace

from greenroof_ros.model.site import Site

# Of the water that plants can take, what may be gone: 'a value of 0.50 for p is commonly used for
# many crops' (FAO-56, chapter 8).
_MAY_BE_GONE = 0.5


def reachable_target(site: Site) -> Site:
    """Return the site with a target that its roof can hold; itself where it holds the present one.

    What is above field capacity drains, so that a target there would be pumped for without end. A
    record says nothing of the target: it is set half-way between wilting point and field capacity,
    and its owner is told to choose another.

    Args:
        site: of a measured roof.
    """
    if site.x2_star < site.z_cap:
        return site
    volume = site.wilting_volume + (1 - _MAY_BE_GONE) * site.available_volume
    depth = float(f"{volume / site.a2:.6g}")  # as it stands in the site file
    return replace(site, z_veg=depth, x2_star=site.a2 * depth)
