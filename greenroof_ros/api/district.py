"""The Python function that simulates a district."""

from __future__ import annotations

import os
from pathlib import Path

from greenroof_ros.analysis.district.result import DistrictResult
from greenroof_ros.analysis.district.run import read_run, simulate_district


def district(
    file: str | os.PathLike[str], *, weather: str | os.PathLike[str] | None = None, jobs: int = 1
) -> DistrictResult:
    """Simulate the discharge of many buildings into one sewer, like ``greenroof district``.

    Args:
        file: path of the district file.
        weather: directory to search for weather files that are not next to the district file.
        jobs: number of threads.

    Returns:
        The results: ``.sentence``, ``.table``, ``.buildings``, ``.hydrographs`` and
        ``.save(directory)``, which writes the page to a new or empty directory.

    Raises:
        ConfigurationError: if a file is invalid; the message names the file and states what
            would be right.

    Example:
        >>> import greenroof_ros as gr
        >>> result = gr.district("my_district.yaml", jobs=2)  # doctest: +SKIP
        >>> result.table["outlet", "adoption", "wet_discharge_m3"]  # doctest: +SKIP
    """
    run = read_run(Path(file), [] if weather is None else [Path(weather)])
    return DistrictResult(run, simulate_district(run, jobs))
