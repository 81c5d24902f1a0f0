"""The one check of values: what a range contains, and wrong values and keys of all files."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, get_args, get_origin

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from places import CONFIG, refusal
from studies import DISTRICT

from greenroof_ros.analysis.district.file import District, read_district
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.parameter import Parameter, parameters_of
from greenroof_ros.base.ranges import Range
from greenroof_ros.live.devices.sensor_file import Sensors, read_sensors
from greenroof_ros.site.file import SITE_KEYS, read_site
from greenroof_ros.weather.description import Description
from greenroof_ros.weather.design_storm import DepthFile, read_depths
from greenroof_ros.weather.read import read_measured

SITE = read_site(CONFIG / "site.yaml")


@pytest.mark.parametrize(("allowed", "wrong"), [
    (Range(-0.1, 2.5, "m"), "2,5"),
    (Range(), 10**400),  # which no float can hold
    (Range(0.0, words=("max",)), "fast"),
])
def test_what_no_range_contains(allowed: Range, wrong: object) -> None:
    with pytest.raises(ValueError, match=r"^must be a"):
        allowed.check(wrong)


@given(value=st.floats() | st.integers(), low=st.floats(-1e6, 1e6), width=st.floats(0, 1e6))
def test_what_is_accepted(value: float, low: float, width: float) -> None:
    """Any number between the ends and at the ends; written as text, too."""
    allowed = Range(low, low + width)
    try:
        assert allowed.check(value) == allowed.parse(str(value)) == value
    except ValueError:
        assert math.isnan(value) or not low <= value <= low + width
    else:
        assert low <= value <= low + width


@given(value=st.floats(-10, 10) | st.integers(-10, 10))
def test_a_whole_number_in_a_file(value: float) -> None:
    """It may be written as 5.0, and becomes an int."""
    allowed = Range(0, 5, "ticks", whole=True)
    read = partial(allowed.read, file=Path("a.yaml"), line=7, key="n")
    if value in range(6):
        number = read(value)
        assert (type(number), number) == (int, value)
    else:
        reason = refusal(read, value)
        assert reason.startswith(f"a.yaml, line 7: n = {value!r}: must be a whole number")


# --- keys of files --------------------------------------------------------------------------------


class Schema(NamedTuple):
    """A kind of file: its keys, the values that a right one has at least, and its reader."""

    keys: Iterable[Parameter]
    least: dict[str, Any]
    read: Callable[[Path], object]


SCHEMAS = {
    "site": Schema(SITE_KEYS.values(), {"extends": "site.yaml"}, read_site),
    "weather": Schema(
        parameters_of(Description), {"file": "a.csv"}, lambda file: read_measured([file], SITE)
    ),
    "district": Schema(parameters_of(District), yaml.safe_load(DISTRICT), read_district),
    "depths": Schema(parameters_of(DepthFile), {"unit": "mm"}, read_depths),
    "sensors": Schema(
        parameters_of(Sensors), yaml.safe_load((CONFIG / "sensors.yaml").read_text()), read_sensors
    ),
}


def wrong_values(key: Parameter) -> Iterator[Any]:
    """Yield values that a key cannot have, by its range and type."""
    kinds = {*get_args(key.kind), key.kind} if get_origin(key.kind) is not dict else set()
    if tuple in (get_origin(kind) for kind in kinds):
        yield {"a": 1}
    elif kinds & {int, float}:
        yield from (math.nan, "many", "5 m3", "5,5", True, [5], {"a": 1})
        ends = math.nextafter(key.low, -math.inf), math.nextafter(key.high, math.inf)
        yield from (end for end in ends if math.isfinite(end))
        if key.whole:
            yield key.low + 0.5
    elif kinds & {bool, str}:
        yield from ([1], {"a": 1}, *["neither"] * (bool in kinds or bool(key.among)))
    else:
        yield from (3, [1])


CASES = [
    (kind, key.name, wrong)
    for kind, schema in SCHEMAS.items() for key in schema.keys for wrong in wrong_values(key)
]


@settings(max_examples=300)
@given(st.sampled_from(CASES) | st.tuples(st.sampled_from([*SCHEMAS]), st.just("kee"), st.just(1)))
def test_wrong_values_and_keys_of_all_files_are_named(case: tuple[str, str, Any]) -> None:
    """With their file, line, key and value, before any other mistake."""
    kind, name, wrong = case
    with TemporaryDirectory() as directory:
        file = Path(directory) / "own.yaml"
        content = {**SCHEMAS[kind].least, name: wrong}
        text = yaml.safe_dump(content, sort_keys=False)
        file.write_text(text)
        with pytest.raises(ConfigurationError) as caught:
            SCHEMAS[kind].read(file)
    line = 1 + [row.partition(":")[0] for row in text.splitlines()].index(name)
    assert str(caught.value).startswith(f"{file}, line {line}: {name}")
    assert str(caught.value.key).partition(".")[0] == name
