"""``greenroof fetch-weather``: a real server sends what the services really send."""

from __future__ import annotations

import io
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from datetime import date, datetime, timedelta, timezone
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
from disks import small_disk
from http_service import WeatherService
from paper import site_file
from places import CHECKOUT, DATA, refusal

import greenroof_ros as gr
from greenroof_ros.base import http
from greenroof_ros.base.console import ProgressBar
from greenroof_ros.base.http import ServiceError
from greenroof_ros.commands import fetch_weather
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site
from greenroof_ros.weather import download
from greenroof_ros.weather.download import (
    Source,
    eccc_station,
    fetch,
    join_blocks,
    open_meteo_archive,
)
from greenroof_ros.weather.quantities import PRECIPITATION, TEMPERATURE
from greenroof_ros.weather.read import read_measured
from greenroof_ros.weather.records import write_records

SITE = read_site(CHECKOUT / "config" / "site.yaml")
LOW_PEAKS = "rain is from a reanalysis"
TODAY = date(2026, 6, 15)


@pytest.fixture
def service() -> Iterator[WeatherService]:
    served = WeatherService()
    yield served
    served.close()


def words(service: WeatherService, *more: str) -> list[str]:
    path = "/climate_data/bulk_data_e.html" if "--eccc" in more else "/v1/archive"
    return ["--url", f"{service.address}{path}", "--output", "out.csv", *more]


def run(service: WeatherService, directory: Path, *more: str) -> CompletedProcess[str]:
    """Run the command in this process, without pauses."""
    out, errors = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(errors):
        patch.chdir(directory)
        patch.setenv("COLUMNS", "500")
        patch.setattr(fetch_weather, "fetch", fetch_at_once)
        patch.setattr(sys, "argv", ["fetch-weather", *words(service, *more)])
        with pytest.raises(SystemExit) as ended:
            fetch_weather.main()
    return CompletedProcess([], int(ended.value.code or 0), out.getvalue(), errors.getvalue())


def fetch_at_once(
    source: Source, site: Site, directory: Path, progress: ProgressBar | None = None
) -> list[Path]:
    return fetch(source._replace(pause_s=0.001), site, directory, progress or ProgressBar())


def test_two_years_come_in_spite_of_all_that_services_send(service, tmp_path):
    service.faults = ["html", "half", "limit", "error", "JSON error", "", "short"]
    done = run(service, tmp_path, "--years", "2023-2024")
    assert (done.returncode, [*tmp_path.iterdir()]) == (0, [tmp_path / "out.csv"]), done.stderr
    for reason in ("is not valid JSON", "IncompleteRead", "429", "503", "went wrong", "instead of"):
        assert reason in done.stderr
    # Each year until it came; years are of the site's clock, so there is a day more at both ends.
    asked = [(query["start_date"], query["end_date"]) for query in service.requests]
    assert asked == 6 * [("2022-12-31", "2023-12-31")] + 2 * [("2024-01-01", "2025-01-01")]
    head = "".join(line for line in (tmp_path / "out.csv").open() if line[0] == "#")
    for text, place in (
        ("CC BY 4.0", done.stdout + head), ("43.60 N, 79.40 W", done.stdout),
        (LOW_PEAKS, done.stdout), (LOW_PEAKS, head), ("rain_kind: reanalysis", head),
        (f"{datetime.now(timezone.utc):%Y-%m-%d}", head), ("latitude: 43.6", head),
    ):
        assert text in place
    # Values of the service at their hours; rain is of the hour before its time.
    records = read_measured([tmp_path / "out.csv"], SITE)
    assert records.first == datetime.fromisoformat("2023-01-01T00:00-05:00")
    for quantity, late in ((PRECIPITATION, 1), (TEMPERATURE, 0)):
        expected = service.values(quantity, records.first + timedelta(hours=late), 17544)
        assert records.values[quantity].tolist() == expected.tolist()


def test_a_run_is_as_with_the_services_own_answer_and_says_that_peaks_are_low(service, tmp_path):
    """Hours that the service does not have are named, and empty."""
    service.faults = ["gap"]
    done = run(service, tmp_path, "--years", "2024")
    assert done.returncode == 0
    # Its hours 100 to 104 from 2023-12-31 on, UTC; rain falls in the hour before.
    missing = dict(re.findall(r"no (\S+) .*?│ +\d+ h │ (.*?)  ", done.stdout))
    assert missing["temperature"] == "2024-01-03T23:00-05:00 to 2024-01-04T03:00-05:00 (5 hours)"
    assert missing["precipitation"].startswith("2024-01-03T22:00-05:00 to")
    assert "\n2024-01-03T23:00:00-05:00,,,,,," in (tmp_path / "out.csv").read_text()
    query = service.requests[-1]
    (tmp_path / "answer.json").write_bytes(service.answer("/v1/archive", query))
    with pytest.warns(UserWarning, match=LOW_PEAKS):
        ours, theirs = (
            gr.simulate(
                "onoff", site=gr.read_site(tau=60.0), weather=tmp_path / file,
                start="2024-07-01T00:00-05:00", hours=72,
            ) for file in ("out.csv", "answer.json")
        )
    assert ours.metrics == theirs.metrics
    assert ours.metrics["rain_m3"] > 0


def test_a_station_has_the_hours_of_its_bulk_files(service, tmp_path):
    """2021 has two real files; the other months have rows without observations."""
    service.faults = ["", "half", "html", "error"]
    done = run(service, tmp_path, "--years", "2021", "--eccc", "48549")
    assert done.returncode == 0, done.stderr
    asked = [int(query["Month"]) for query in service.requests]
    assert asked == [1, 2, 2, 2, 2, *range(3, 13)]
    assert {query["stationID"] for query in service.requests} == {"48549"}
    text = (tmp_path / "out.csv").read_text()
    assert "Open Government Licence - Canada" in text
    assert "rain_kind" not in text
    assert "2021-01-01T00:00-05:00 to 2021-02-28T23:00" in done.stdout
    # All values of the real files, bit for bit, and no others.
    ours = read_measured([tmp_path / "out.csv"], SITE)
    assert (ours.hours, ours.rain_late) == (8760, 1)
    known = 0
    for month in ("03", "07"):
        real = read_measured([DATA / f"en_climate_hourly_{month}-2021.csv"], SITE)
        at = (real.first - ours.first) // timedelta(hours=1)
        for name, series in real.values.items():
            part = ours.values[name][at : at + real.hours]
            assert np.array_equal(part, series, equal_nan=True)
        known += np.count_nonzero(~np.isnan(real.values[PRECIPITATION]))
    assert np.count_nonzero(~np.isnan(ours.values[PRECIPITATION])) == known


@pytest.mark.parametrize("ended_by", [signal.SIGKILL, signal.SIGINT])
def test_what_came_before_the_end_is_not_requested_again(service, tmp_path, ended_by):
    service.faults = ["", "slow"]
    process = subprocess.Popen(
        [sys.executable, "-m", "greenroof_ros", "fetch-weather",
         *words(service, "--years", "2023-2024")],
        cwd=tmp_path, text=True, stderr=subprocess.PIPE,
    )
    while len(service.requests) < 2:
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(ended_by)
    _, errors = process.communicate(timeout=60)
    assert not (tmp_path / "out.csv").exists()
    if ended_by == signal.SIGINT:
        assert process.returncode == 130
        assert "Traceback" not in errors
    done = run(service, tmp_path, "--years", "2023-2024")
    assert done.returncode == 0, done.stderr
    starts = [query["start_date"] for query in service.requests]
    assert starts == ["2022-12-31", "2024-01-01", "2024-01-01"]
    assert sorted(tmp_path.iterdir()) == [tmp_path / "out.csv"]


@pytest.mark.parametrize("left", [0.0, 0.5])
def test_a_part_that_a_power_cut_has_damaged_is_requested_again(service, tmp_path, left):
    source = archive(service, range(2022, 2024))
    part, whole = fetch_at_once(source, SITE, tmp_path)
    good, body = whole.read_bytes(), part.read_bytes()
    part.write_bytes(body[: int(left * len(body))])
    fetch_at_once(source, SITE, tmp_path)
    assert (part.read_bytes(), whole.read_bytes()) == (body, good)
    starts = [query["start_date"][:4] for query in service.requests]
    assert starts == ["2021", "2023", "2021"]


def test_a_full_disk_is_named_and_a_larger_one_goes_on(service, tmp_path):
    with small_disk(tmp_path / "disk", "500k"):
        done = run(service, tmp_path / "disk", "--years", "2023-2024")
        assert done.returncode == 1
        assert "No space left on device" in done.stderr
        assert not (tmp_path / "disk" / "out.csv").exists()


@pytest.mark.parametrize(("options", "key", "requests"), [
    (["--years", "1940-1950"], "--years", 0),
    (["--years", "2199", "--eccc", "48549"], "years = 2199", 0),
    (["--years", "2020", "--eccc", "6158359"], "--eccc", 0),  # the number of another list
    (["--years", "2020", "--url", "ftp://a"], "http", 0),
    (["--years", "2020", "--output", "old.csv"], "--output = 'old.csv'", 0),
    (["--years", "2020", "--site", "nowhere.yaml"], "longitude", 0),
    (["--years", "2020", "--site", "nowhere.yaml", "--eccc", "1"], "offset", 1),
    (["--eccc", "48549", "--years", "1999"], "no hourly records for these years", 12),
    (["--years", "2020", "--site", "high.yaml"], "must be within 300 m of the site's", 1),
])
def test_what_cannot_be_is_refused_at_once(service, tmp_path, options, key, requests):
    (tmp_path / "old.csv").write_text("mine")
    site_file(tmp_path, elevation=1000.0).rename(tmp_path / "high.yaml")
    lines = site_file(tmp_path).read_text().splitlines()
    place = ("latitude", "longitude", "utc_offset")
    (tmp_path / "nowhere.yaml").write_text(
        "\n".join(line for line in lines if not line.startswith(place))
    )
    done = run(service, tmp_path, *options)
    assert done.returncode == 2 and len(service.requests) == requests
    assert key in " ".join(done.stderr.split()) and "Traceback" not in done.stderr
    assert (tmp_path / "old.csv").read_text() == "mine"


def test_a_key_in_the_url_reaches_the_service_and_nothing_else(service, tmp_path):
    """Neither messages nor files have it, even if the service repeats it; other keys are others."""
    key = "s3cr%C3%A9t-0815"
    service.faults = ["", "control"]
    paid = f"{service.address}/v1/archive?apikey={key}&models=#top"
    done = run(service, tmp_path, "--years", "2022-2023", "--url", paid)
    assert done.returncode == 1
    assert all(query["apikey"] == "s3crét-0815" for query in service.requests)
    part = tmp_path / "out.csv.part"
    texts = [file.read_text() for file in part.iterdir()] + [done.stdout, done.stderr]
    assert len(texts) == 3 and not any("0815" in text for text in texts)
    # What came with the key was escaped, too: it would clear the screen.
    assert "\\x1b[2J\\x07\\u202einvalid String value apikey=***&models=&lat" in done.stderr
    assert not {"\33", "\7", "\u202e"} & {*done.stderr}
    done = run(service, tmp_path, "--years", "2022-2023", "--url", paid)
    assert done.returncode == 0 and len(service.requests) == 3
    assert "0815" not in (tmp_path / "out.csv").read_text() + done.stdout + done.stderr


@pytest.mark.parametrize("url", [
    "archive-api.open-meteo.com/?apikey=s3cr3t", "http://[::1/?apikey=s3cr3t",
    "http://host:99999/?apikey=s3cr3t", "http://me:s3cr3t@host/", "http://host/a b?apikey=s3cr3t",
])
def test_a_url_that_cannot_be_is_refused_without_its_key(url):
    told = refusal(open_meteo_archive, SITE, range(2020, 2021), TODAY, url)
    assert told.startswith("url: must begin with http://") and "s3cr3t" not in told


def archive(service: WeatherService, years: range = range(2020, 2021)) -> Source:
    return open_meteo_archive(SITE, years, TODAY, f"{service.address}/v1/archive")


def failure(service: WeatherService, directory: Path, source: Source) -> str:
    with pytest.raises(ServiceError) as caught:
        fetch_at_once(source, SITE, directory)
    return str(caught.value)


@pytest.mark.parametrize(("fault", "requests", "reason"), [
    # Both with the status 400, in the words of Open-Meteo's source.
    ("No data is available for this location", 1, "400"),
    ("Timeout while reading value from disk", 8, "400"),
    ("unknown", 1, "404"), ("fewer", 1, "solar radiation"), ("dry", 1, "precipitation"),
    ("tomorrow", 1, "Daily"), ("html", 8, "valid JSON"), ("half", 8, "IncompleteRead"),
    ("short", 8, "instead of"), ("length", 8, "temperature_2m"), ("other", 8, "sent 2009-12-30"),
    ("deep", 8, "nested too deeply"),
])
def test_what_does_not_pass_is_tried_once_and_what_may_pass_eight_times(
    service, tmp_path, fault, requests, reason
):
    service.faults = 9 * [fault]
    told = failure(service, tmp_path / "part", archive(service))
    assert reason in told and told.startswith("2019-12-31 to 2021-01-01: ")
    assert len(service.requests) == requests
    service.faults = []  # nothing of it is kept
    assert len(fetch_at_once(archive(service), SITE, tmp_path / "part")) == 1
    assert len(service.requests) == requests + 1


def test_a_slow_service_is_given_up(service, tmp_path, monkeypatch):
    monkeypatch.setattr(http, "ANSWER_S", 0.2)
    service.faults = 9 * ["slow"]
    assert "no complete response within 0.2 s" in failure(service, tmp_path, archive(service))


@pytest.mark.parametrize(("error", "wait"), [
    (ServiceError("429: Minutely API request limit exceeded. Please try again in one minute."), 60),
    (ServiceError("429 Too Many Requests", 5.0), 5),
    (ServiceError("503 Service Unavailable"), 0),
])
def test_a_service_is_left_alone_as_long_as_it_asks(error, wait):
    assert download._find_wait(error) == wait


def test_rain_that_no_gauge_measured_is_noted_also_beside_a_gauges(tmp_path):
    head, rows = "time,rain [mm]\n", "2024-06-{0}T00:00-05:00,1\n2024-06-{0}T01:00-05:00,2\n"
    gauge, model, again = (tmp_path / f"{name}.csv" for name in ("gauge", "model", "again"))
    gauge.write_text(head + rows.format("01"))
    model.write_text("# rain_kind: reanalysis\n" + head + rows.format("02"))
    assert read_measured([gauge], SITE).rain_note == ""
    both = read_measured([gauge, model], SITE)
    assert LOW_PEAKS in both.rain_note
    again.write_text(write_records(both, "Written again."))
    assert LOW_PEAKS in again.read_text()
    assert read_measured([again], SITE).rain_note == both.rain_note


def test_parts_of_another_request_are_not_used(service, tmp_path):
    service.faults = ["", "No data is available for this location"]
    failure(service, tmp_path, archive(service, range(2019, 2021)))
    address = f"{service.address}/v1/archive"

    def has_first(site: Site, url: str) -> bool:
        source = open_meteo_archive(site, range(2019, 2022), TODAY, url)
        return source.files(tmp_path)[0].exists()

    assert has_first(SITE, address)
    assert not has_first(SITE, f"{address}?models=era5")
    assert not has_first(replace(SITE, latitude=43.7), address)


@pytest.mark.parametrize(("offset", "expected"), [(None, "-05:00"), (-3.5, "+00:00")])
def test_years_are_of_the_sites_clock_or_of_solar_time(service, tmp_path, offset, expected):
    """With an offset of half an hour they are of UTC, in whose whole hours the service's are."""
    site = replace(SITE, utc_offset=offset)
    source = open_meteo_archive(site, range(2020, 2021), TODAY, f"{service.address}/v1/archive")
    records = join_blocks(fetch_at_once(source, site, tmp_path), site, range(2020, 2021))
    assert records.first == datetime.fromisoformat(f"2020-01-01T00:00{expected}")
    assert (records.hours, records.first.isoformat()[-6:]) == (8784, expected)
    assert not np.isnan(records.values[PRECIPITATION]).any()


def test_the_present_year_ends_where_the_archive_does_and_first_years_where_it_begins(service):
    days = [(f"{block.first}", f"{block.last}") for block in archive(
        service, range(2025, 2027)
    ).blocks]
    assert days == [("2024-12-31", "2025-12-31"), ("2026-01-01", "2026-06-09")]
    assert archive(service, range(1971, 1972)).blocks[0].first == date(1971, 1, 1)
    months = eccc_station(1, range(2026, 2027), TODAY).blocks
    assert [block.first.month for block in months] == [1, 2, 3, 4, 5, 6]
    assert (months[1].last, months[-1].last) == (date(2026, 2, 28), TODAY)
