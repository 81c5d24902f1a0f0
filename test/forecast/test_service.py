"""Forecasts from the internet: what a service answers, in each way in which this can go wrong."""

import json
import os
import tempfile
import time
from contextlib import closing, contextmanager
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest
from commands import run_command
from disks import fill, small_disk
from graphs import environment
from http_service import HttpService, WeatherService
from places import CONFIG

from greenroof_ros.base import http
from greenroof_ros.base.http import ServiceError
from greenroof_ros.forecast.issue import (
    IssuedForecast,
    read_archive,
    read_forecasts,
    write_forecasts,
)
from greenroof_ros.forecast.live import (
    ATTRIBUTION,
    Fetcher,
    ForecastFiles,
    Service,
)
from greenroof_ros.forecast.models import FileModel
from greenroof_ros.site.file import read_site
from greenroof_ros.weather.read import default_weather, read_weather
from greenroof_ros.weather.records import HOUR

SITE = read_site(CONFIG / "site.yaml")


@pytest.fixture(scope="module")
def server():
    served = WeatherService()
    yield served
    served.close()


def _service(server, **wanted):
    server.fault = ""
    kind = "ensemble" if wanted.get("ensemble") else "forecast"
    return Service(SITE, url=f"{server.address}/v1/{kind}", **wanted)


def _fetcher(service, directory, archive=None):
    return Fetcher(service, ForecastFiles(directory / "forecast.csv", archive).write, 1800)


def _now():
    return datetime.now(timezone.utc)


def test_each_hour_has_the_rain_and_temperature_that_are_forecast_for_it(server):
    now = _now()
    issue = _service(server).fetch(now)
    assert issue.issued == now.replace(minute=0, second=0, microsecond=0)
    # Rain is of the hour before its time.
    rain = server.values("precipitation", issue.issued + HOUR, issue.hours)
    temperature = server.values("temperature", issue.issued, issue.hours)
    assert issue.rain.tolist() == [rain.tolist()] and rain.any()
    assert issue.values["temperature"].tolist() == temperature.tolist()
    assert 6 * 24 <= issue.hours <= 7 * 24
    assert 1 < issue.values["evapotranspiration"].max() < 20
    assert 0 <= issue.values["evapotranspiration"].min() < 0.5


@pytest.mark.parametrize(("fault", "reason"), [
    ("refused", "Remote end closed connection"),
    ("slow", "sent no complete response within 0.5 s"),
    ("slow head", "sent no complete response within 0.5 s"),
    ("half", "IncompleteRead"), ("html", "not valid JSON"), ("long limit", "429"), ("error", "503"),
    ("length", "temperature_2m"), ("dry", "has no precipitation"),
])
def test_a_bad_answer_is_refused_and_replaces_nothing(server, tmp_path, monkeypatch, fault, reason):
    file = tmp_path / "forecast.csv"
    fetcher = _fetcher(_service(server), tmp_path, tmp_path / "kept")
    assert fetcher.fetch() == 1800
    assert fetcher.problem == ""
    before = file.read_text()
    server.fault = fault
    if "slow" in fault:
        monkeypatch.setattr(http, "ANSWER_S", 0.5)
    began = time.monotonic()
    waits = [fetcher.fetch() for _ in range(2)]
    assert time.monotonic() - began < 6  # a slow head would take twice 8 s
    with pytest.raises(ServiceError, match=reason):
        raise ServiceError(fetcher.problem)
    assert waits == ([120, 120] if fault == "long limit" else [60, 120])
    assert file.read_text() == before
    server.fault = ""
    assert fetcher.fetch() == 1800
    assert fetcher.problem == ""


@contextmanager
def _answering(status, headers, body):
    class Answering(HttpService):
        def respond(self, request):
            self.send(request, status, body, headers)

    with closing(Answering()) as served:
        yield Service(SITE, url=f"{served.address}/")


@pytest.mark.parametrize("asks", ["99999999999", "Fri, 31 Dec 9999 23:59:59 GMT"])
def test_a_service_is_left_alone_for_a_day_at_most(tmp_path, asks):
    with _answering(429, {"Retry-After": asks}, b"") as service:
        fetcher = _fetcher(service, tmp_path)
        assert fetcher.fetch() == 86_400


def test_what_is_new_in_any_hour_and_quantity_is_kept():
    """The same values are unchanged, although the first hours passed; any new value counts."""
    issued = _now().replace(minute=0, second=0, microsecond=0)
    before, same, longer = (
        {"precipitation": np.zeros((1, n)), "evapotranspiration": np.ones(n),
         "temperature": np.ones(n)} for n in (48, 43, 48)
    )
    for new in (
        {}, longer, {"precipitation": np.eye(1, 43, 42)}, {"precipitation": np.zeros((2, 43))},
        {"temperature": np.zeros(43)}, {"evapotranspiration": np.zeros(43)},
    ):
        later = _issue(issued + 5 * HOUR, {**same, **new})
        assert later.repeats(_issue(issued, before)) is not bool(new)


def _issue(available: datetime, values):
    issued = available.replace(minute=0, second=0)
    return IssuedForecast(issued, available, Path("x"), None, values)


def test_what_is_kept_is_an_archive_without_repetitions(server, tmp_path):
    kept, before = tmp_path / "kept", _now()
    fetcher = _fetcher(_service(server, ensemble=True), tmp_path, kept)
    for _ in range(2):
        fetcher.fetch()
    (file,) = kept.iterdir()
    assert before <= fetcher.newest.available <= _now()
    assert ATTRIBUTION in file.read_text().splitlines()[0]
    (issue,) = read_forecasts(tmp_path / "forecast.csv")
    for kept_issue in (*read_archive(kept, SITE), issue):
        assert kept_issue.repeats(fetcher.newest)
    assert len({tuple(member) for member in issue.rain.tolist()}) == 11
    assert np.array_equal(issue.rain[0], _service(server).fetch(_now()).rain[0])


@pytest.mark.parametrize(("sizes", "kept"), [
    # GB of earlier forecasts, the oldest first; the new one of some kB is kept in any case.
    ([0.9, 0.9, 0.9], [False, True, True]), ([3.0], [False]), ([0.5] * 3, [True] * 3),
])
def test_the_oldest_kept_forecasts_go_beyond_the_limit(server, tmp_path, sizes, kept):
    """What no one prunes fills the disk: an hourly ensemble is 4 GB a year. Other files stay."""
    archive = tmp_path / "kept"
    archive.mkdir()
    files = [archive / f"2020010{day}000000.csv" for day in range(1, len(sizes) + 1)]
    for file, size in zip([*files, archive / "notes.csv"], [*sizes, 5.0], strict=True):
        file.touch()
        os.truncate(file, int(size * 1e9))
    fetcher = _fetcher(_service(server), tmp_path, archive)
    assert (fetcher.fetch(), fetcher.problem) == (1800, "")
    assert [file.exists() for file in files] == kept
    assert len(list(archive.iterdir())) == sum(kept) + 2


def test_a_full_directory_for_temporary_files_costs_no_forecast(server, tmp_path, monkeypatch):
    """Nor does a file that cannot be kept: the forecast is there, and the attempt has failed."""
    with small_disk(tmp_path / "full", "64k"):
        fill(tmp_path / "full" / "file")
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "full"))
        fetcher = _fetcher(_service(server), tmp_path / "full")
        assert fetcher.fetch() == 60
        assert "No space left on device" in fetcher.problem
        assert np.array_equal(fetcher.newest.rain, _service(server).fetch(_now()).rain)


def test_the_command(server, tmp_path):
    """No control character or direction mark reaches the terminal."""
    file = tmp_path / "\33[31m\u202e.csv"
    asked = ("fetch_forecast", "--url", f"{server.address}/v1/ensemble", "--ensemble")
    ended = run_command(*asked, "--output", file.name, cwd=tmp_path, env=environment(0))
    assert ended.returncode == 0, ended.stderr
    assert "11 members; forecasts by Open-Meteo.com, CC BY 4.0" in ended.stdout
    assert ended.stdout.startswith(r"\x1b[31m\u202e.csv: issued ")
    assert len(read_forecasts(file)[0].rain) == 11
    server.fault = "error"
    ended = run_command(*asked, cwd=tmp_path, env=environment(0))
    assert ended.returncode == 1
    assert ended.stderr.startswith("error: ")


def test_what_an_answer_lacks_is_noted_and_the_rest_is_used(server):
    """The rest of an answer without temperature, and with an hour without rain, is used."""
    _service(server).fetch(_now())
    content = json.loads(server.answer("/v1/forecast", server.requests[-1]))
    hourly = content["hourly"]
    hourly["temperature_2m"] = [None] * len(hourly["time"])
    content["hourly_units"]["temperature_2m"] = "undefined"
    hourly["precipitation"][70] = None
    body = json.dumps(content).encode()
    with _answering(200, {}, body) as service:
        issue = service.fetch(_now())
    assert issue.hours > 5 * 24 and "temperature" not in issue.values
    assert not any(np.isnan(series).any() for series in issue.values.values())
    assert 0.5 < issue.values["evapotranspiration"].mean() < 8
    for note in ("monthly means, for lack of temperature", "1 missing hours of precipitation"):
        assert any(note in text for text in issue.notes)


def _issues_arriving(*arrivals: str) -> list[IssuedForecast]:
    """Return issues of the hours in which they arrived, each with its number as its rain."""
    issues = []
    for number, arrival in enumerate(arrivals, 1):
        issues.append(_issue(datetime.fromisoformat(arrival), {
            "precipitation": np.full((1, 48), float(number)), "evapotranspiration": np.ones(48),
        }))
    return issues


@pytest.mark.parametrize(("arrivals", "known"), [
    # At the start of each hour, the number of the newest; 02:59 is known at 03:00.
    (["02:10:00", "02:50:00", "04:59:59"], {3: 2.0, 4: 2.0, 5: 3.0}),
    (["01:59:00", "02:59:00", "03:00:01", "05:00:00"], {2: 1.0, 3: 2.0, 4: 3.0, 5: 4.0}),
])
def test_no_forecast_is_known_before_it_arrived(arrivals, known, tmp_path):
    """And none replaces another of its hour: what is written is read again, issue by issue."""
    issues = _issues_arriving(*(f"2021-07-07T{arrival}-05:00" for arrival in arrivals))
    for issue in issues:
        file = tmp_path / f"{issue.available:%Y%m%d%H%M%S}.csv"
        file.write_text(write_forecasts([issue]))
    whole = tmp_path.parent / f"{tmp_path.name}.csv"  # all in one file
    whole.write_text(write_forecasts(issues))
    records = read_weather([default_weather()], SITE)
    for source in (tmp_path, whole):
        read = read_archive(source, SITE)
        assert [issue.available for issue in read] == [issue.available for issue in issues]
        model = FileModel(read, records, all_members=False)
        for hour, number in known.items():
            assert model.forecast(hour - records.first.hour, 3)[0][0, 1] == number, (hour, source)
        for issue in read_archive(source, SITE, 4.0):  # a delay that is given counts instead
            assert issue.available - issue.issued == 4 * HOUR


def test_the_services_wind_is_at_ten_metres_even_if_the_sites_is_not(server):
    """A wind at 10 m treated as at 2 m would be a third too fast in Penman-Monteith."""
    low = replace(SITE, wind_height=2.0)
    there, here = (
        Service(site, url=f"{server.address}/v1/forecast").fetch(_now()) for site in (low, SITE)
    )
    assert there.repeats(here)
