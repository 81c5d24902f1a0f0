"""The charts: what is drawn is what happened, extremes included, at the site's own time."""

from __future__ import annotations

from datetime import datetime, timezone

import pytest

import greenroof_ros as gr
from greenroof_ros.api.simulate import Comparison
from greenroof_ros.base.errors import ConfigurationError

NAMES = {"on/off": "onoff", "MPC": "mpc"}


@pytest.fixture(scope="module")
def compared() -> Comparison:
    return gr.compare(NAMES, hours=3)


def points(chart: object, panel: int) -> list[dict[str, object]]:
    """Return the points of a panel's lines; panel 0 is the rain."""
    described = chart.to_dict()  # type: ignore[attr-defined]
    view = described["vconcat"][panel]
    layer = view["layer"][-1] if "layer" in view else view
    return list(described["datasets"][layer.get("data", view.get("data"))["name"]])


def test_panels(compared: Comparison) -> None:
    """Each controller has its line in each panel but the rain's, with its extremes."""
    chart = compared.plot()
    for panel, (column, factor) in enumerate(
        (("roof_level_m", 1000), ("cistern_level_m", 1), ("pump_flow_m3_per_s", 1000)), start=1
    ):
        rows = points(chart, panel)
        assert {row["case"] for row in rows} == set(NAMES)
        assert len(rows) < 2 * 550
        for name, result in compared.results.items():
            values = result.trajectory[column] * factor
            if panel == 3:
                values = values[:-1]  # the last flow is not applied
            drawn = [row["v"] for row in rows if row["case"] == name]
            assert max(drawn) == pytest.approx(values.max(), rel=1e-6)
            assert min(drawn) == pytest.approx(values.min(), rel=1e-6)
    assert max(row["v"] for row in points(chart, 0)) == pytest.approx(3.0)  # mm/h


def test_the_axis_has_the_sites_time(compared: Comparison) -> None:
    """Its times are local times, drawn as if they were UTC: the same in every browser."""
    times = [row["t"] for row in points(compared.plot(), 1)]
    local = [datetime.fromtimestamp(t / 1000, timezone.utc) for t in (min(times), max(times))]
    assert [f"{time:%Y-%m-%d %H:%M}" for time in local] == ["2021-07-07 02:00", "2021-07-07 05:00"]
    bottom = compared.plot().to_dict()["vconcat"][-1]["encoding"]["x"]
    assert bottom["scale"]["type"] == "utc"


def test_table(compared: Comparison) -> None:
    """A row for each; results are used as they are."""
    table = compared.table
    assert table["controller"].to_list() == list(NAMES)
    for name, deviation in table["controller", "total_deviation_m3"].rows():
        assert deviation == compared.results[name].metrics["total_deviation_m3"]
    again = gr.compare({"one": compared.results["MPC"]}, hours=1)
    assert again.results["one"] is compared.results["MPC"]


def test_runs_of_different_sites(compared: Comparison) -> None:
    """Each with the levels of its own site, and no reference level that is one's alone."""
    large = gr.simulate("onoff", hours=4, site=gr.read_site(a2=100.0, z_veg=0.04))
    chart = gr.compare({"own": large, **compared.results}).plot()
    highest = max(row["v"] for row in points(chart, 1) if row["case"] == "own")
    assert highest == pytest.approx(1000 * large.trajectory["roof_level_m"].max(), rel=1e-6)
    assert ["'target'" in str(each.to_dict()) for each in (compared.plot(), chart)] == [True, False]
    local = max(datetime.fromtimestamp(row["t"] / 1000, timezone.utc) for row in points(chart, 0))
    assert f"{local:%H:%M}" == "06:00"


def test_runs_of_different_lengths_are_refused(compared: Comparison) -> None:
    both = gr.compare({**compared.results, "later": gr.simulate("onoff", hours=1)})
    with pytest.raises(ConfigurationError, match="all runs: must have the same length"):
        both.table  # noqa: B018
