"""The Python function that simulates a district."""

from __future__ import annotations

import os
from pathlib import Path

from greenroof_ros.analysis.district.result import DistrictResult, simulate_district


def district(
    file: str | os.PathLike[str], *, weather: str | os.PathLike[str] | None = None, jobs: int = 1,
    swmm: str | os.PathLike[str] | None = None,
) -> DistrictResult:
    """Simulate the discharge of many buildings into one sewer, like ``greenroof district``.

    Args:
        file: path of the district file.
        weather: directory to search for weather files that are not next to the district file.
        jobs: number of threads.
        swmm: directory for networks that EPA SWMM routes; None without routing.

    Returns:
        The results: ``.sentence``, ``.table`` (means with 5th and 95th percentiles), ``.all_rows``
        (every draw and season), ``.buildings``, ``.hydrographs`` and ``.save(directory)``, which
        writes the page.

    Raises:
        ConfigurationError: if a file is invalid; the message names the file and states what
            would be right.

    Example:
        >>> import greenroof_ros as gr
        >>> result = gr.district("my_district.yaml", jobs=2)  # doctest: +SKIP
        >>> result.table["outlet", "adoption", "wet_discharge_m3"]  # doctest: +SKIP
    """
    places = [] if weather is None else [Path(weather)]
    return simulate_district(Path(file), places, jobs, None if swmm is None else Path(swmm))
