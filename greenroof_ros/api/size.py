"""The Python function that compares sizes of cisterns."""

from __future__ import annotations

from typing import Any

from greenroof_ros.analysis.sizing.run import OPTIONS, size_site
from greenroof_ros.analysis.sizing.sizes import Sizes
from greenroof_ros.base.errors import ConfigurationError, suggest_names


def size(**options: Any) -> Sizes:
    """Compare cisterns, targets and outlets over all seasons of a record, like ``greenroof size``.

    Args:
        options: the options below; None for the default.

            - ``site``: a site file, or a site from ``gr.read_site``; by default the paper's site.
            - ``weather``: files, a pattern or a data frame, as for ``gr.simulate``, with at least
              one season.
            - ``evapotranspiration``, ``gaps``: as for ``gr.simulate``.
            - ``volumes``: volumes of the cistern up to its overflow (m3); by default the site's
              own, and volumes that suit the roof and the catchment.
            - ``targets``: target depths of the water on the roof (mm); by default the site's
              target, and steps of a twentieth of what the soil holds.
            - ``outlets``: any of ``"none"``, ``"drain"`` and ``"plan"``; by default all three.
            - ``season``: first and last day of the season, as in ``"05-01/10-31"``; by default May
              to October, or November to April south of the equator.
            - ``knee``: minimum volume of water that each additional m3 of cistern must save per
              season (m3), by default 1.
            - ``mains_price``, ``storm_water_price``, ``cistern_price`` (each per m3), and
              ``cistern_years``, the number of years over which the price of the cistern is spread:
              give all four, or none.
            - ``jobs``: number of threads, by default 1.

    Returns:
        The results: ``.sentence``, ``.table``, ``.table_of_seasons``, ``.plot()`` and
        ``.save(directory)``, which writes the page.

    Raises:
        ConfigurationError: if an input is invalid; the message names the input and states what
            would be right.

    Example:
        >>> import greenroof_ros as gr
        >>> sizes = gr.size(
        ...     site="config/site_valve.yaml", weather="config/weather/toronto_2021-07.csv",
        ...     season="07-07/07-08", volumes=[5, 10], targets=[36, 39], outlets=["none"],
        ... )
        >>> sizes.recommended.target
        36.0
    """
    for name in options:
        if name not in OPTIONS:
            raise ConfigurationError(
                f"is not an option; {suggest_names(name, OPTIONS)}", key=name, value=options[name]
            )
    return size_site(options)
