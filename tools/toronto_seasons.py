"""Write config/weather/toronto_2014-2025.csv.gz from the monthly files of a weather station.

``python tools/toronto_seasons.py DIR`` reads the hourly bulk files (YYYY_M.csv) of Toronto City
Centre, climate id 6158359, as Environment and Climate Change Canada provides them.
"""

from __future__ import annotations

import argparse
import gzip
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from greenroof_ros.site.file import read_site
from greenroof_ros.weather.read import find_files, read_measured
from greenroof_ros.weather.records import write_records

ABOUT = """\
Toronto City Centre, June 2014 to December 2025, hourly; empty cells are missing.
Observations: Environment and Climate Change Canada, Historical Data, hourly bulk files of
Toronto City Centre (climate id 6158359), Open Government Licence - Canada
(open.canada.ca/en/open-government-licence-canada).
A record holds for the hour that starts at its time stamp."""


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directory", metavar="DIR", help="directory of the monthly files")
    months = find_files([f"{parser.parse_args().directory}/20*_*.csv"], "DIR")
    records = read_measured(months, read_site(ROOT / "config" / "site.yaml"))
    packed = gzip.compress(write_records(records, ABOUT).encode(), mtime=0)
    (ROOT / "config" / "weather" / "toronto_2014-2025.csv.gz").write_bytes(packed)


if __name__ == "__main__":
    main()
