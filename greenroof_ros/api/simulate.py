"""Python functions that simulate, compare simulations, and read the trajectory from a bag."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from greenroof_ros.base.errors import ConfigurationError, rename_keys, require_extra
from greenroof_ros.base.files import default_site_file, find_shipped
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.times import duration, to_minutes
from greenroof_ros.controllers.decide import valid_number
from greenroof_ros.controllers.outlet import SHARE
from greenroof_ros.controllers.registry import ControllerChoice, choose_class, find_controller
from greenroof_ros.physics.storm_water import Event
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.results.table import make_frame
from greenroof_ros.results.trajectory import COLUMNS, TRAJECTORY, Time, Trajectory, zone_name
from greenroof_ros.simulation import loop
from greenroof_ros.simulation.inputs import RunInputs, make_inputs
from greenroof_ros.simulation.output import make_run_directory, write_configuration, write_summary
from greenroof_ros.simulation.run import Run, Values
from greenroof_ros.site import file as site_file
from greenroof_ros.site.horizon import MAX_HORIZON
from greenroof_ros.site.site import Site

if TYPE_CHECKING:
    import altair
    import polars



def read_site(path: str | Path | None = None, **changes: Any) -> Site:
    """Read a site file, or the paper's site if no file is given.

    Volumes that depend on changed values are recomputed, such as the target volume ``x2_star`` if
    the target level ``z_veg`` changes.

    Args:
        path: path of the file, or name of a file of this package such as ``site_valve.yaml``; None
            for the paper's site.
        changes: values that replace those in the file, each under the name of a parameter or of a
            key that the file itself uses, such as ``cistern_volume`` and ``roof_area``.

    Raises:
        ConfigurationError: if the file or a value is invalid.

    Example:
        >>> import greenroof_ros as gr
        >>> site = gr.read_site(z_veg=0.04)
        >>> round(site.x2_star, 3), site.a2
        (2.752, 68.8)
    """
    return site_file.read_site(find_shipped(Path(path or default_site_file())), changes)


def build_run(inputs: RunInputs) -> Run:
    """Build and check a run, and issue its notes as warnings.

    A warning names the line that called the caller.

    Raises:
        ConfigurationError: if an input is invalid.
    """
    run = inputs.build()
    warn([*run.notes(), *run.weather_notes()], level=4)
    return run


def warn(notes: Iterable[str], level: int) -> None:
    """Issue notes as warnings that name the line at a level of the stack, in which this is 1."""
    for note in notes:
        warnings.warn(note, stacklevel=level)


class SiteState(NamedTuple):
    """The state of a site at a tick."""

    time: datetime
    """time of the tick, with its offset from UTC"""
    cistern_level: float
    """m"""
    roof_level: float
    """m"""
    site: Site
    """the site's parameters, such as ``z_veg``, the target of the roof's level (m)"""

    @property
    def cistern(self) -> float:
        """Volume in the cistern (m3)."""
        return self.site.cistern_volume(self.cistern_level)

    @property
    def roof(self) -> float:
        """Volume on the roof (m3)."""
        return self.site.roof_volume(self.roof_level)


class ForecastSteps(NamedTuple):
    """A forecast divided into steps, the first of which begins now.

    Each value is the mean over a step.
    """

    rain: Values
    """rain (m/s), shape (steps,)"""
    evapotranspiration: Values
    """evapotranspiration from the whole bed (m3/s), shape (steps,)"""
    ends: Values
    """ends of the steps (s from now), the first 0, shape (steps + 1,); step i lasts from
    ``ends[i]`` to ``ends[i + 1]``"""


Function = Callable[[SiteState, ForecastSteps], Any]
"""A controller: a function that returns the command, as a share of the pumps' maximum flow from 0
to 1; or the command and the opening of the valve on the low outlet, as a share from 0 to 1, or None
to leave the valve to its policy."""
NEEDS_VALVE = "needs a site with a valve (low_outlet_valve: true)"


class FunctionController:
    """A controller that calls a function; a subclass provides the function."""

    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter(
        "horizon", 24.0, "h", 0.1, MAX_HORIZON,
        "length of the forecast, which is divided into steps of increasing length",
    ),)
    function: ClassVar[Function]
    forecast_ends: Values = np.empty(0)
    start: datetime
    """start of the run, which is set before the run"""
    opening: float | None = None
    """opening of the valve that the function returned last; None to leave it to the policy"""
    time_ns = 0

    def __init__(self, site: Site, horizon: float) -> None:
        self._site, self._tick = site, -1

    def command(self, cistern_level: float, roof_level: float, *forecast: Any) -> float:
        """Return the command of the function, and note the opening of the valve.

        Raises:
            ControllerError: if one of them is not a number from 0 to 1, or an array of one.
            ConfigurationError: if the function commands a valve that the site does not have.
        """
        self._tick += 1
        time = self.start + timedelta(seconds=self._tick * self._site.tau)
        state = SiteState(time, cistern_level, roof_level, self._site)
        steps = ForecastSteps._make(map(np.asarray, (*forecast, self.forecast_ends)))
        returned = type(self).function(state, steps)
        both = isinstance(returned, tuple) and len(returned) == 2
        command, self.opening = returned if both else (returned, None)
        if self.opening is not None:
            if not self._site.low_outlet_valve:
                raise ConfigurationError(NEEDS_VALVE, key="outlet", value=self.opening)
            self.opening = self._read("the opening of the valve", self.opening)
        return self._read("the command", command)

    def _read(self, subject: str, value: Any) -> float:
        with suppress(TypeError, ValueError):  # anything else is rejected, and named
            value = np.asarray(value, np.float64).item()
        return valid_number(type(self), "command", subject, value, SHARE)

    def skip(self) -> None:
        """Count a tick in which the pump must not run."""
        self._tick += 1

    def statistics(self) -> None:
        """Return None, since the controller has no solver."""


def choose_controller(controller: Any) -> ControllerChoice:
    """Return the choice of a controller.

    Args:
        controller: a name, ``package.module:Class``, a class, or a function of a :class:`SiteState`
            and :class:`ForecastSteps`.

    Raises:
        ConfigurationError: if the controller is not of any of these kinds.
    """
    if isinstance(controller, str):
        return find_controller(controller)
    if isinstance(controller, type):
        return choose_class(controller)
    if not callable(controller):
        raise ConfigurationError(
            "must be a name, a class, or a function of (state, forecast)", key="controller",
            value=controller,
        )
    name = getattr(controller, "__name__", type(controller).__name__).strip("<>")
    return choose_class(type(name, (FunctionController,), {
        "function": staticmethod(controller), "__module__": controller.__module__,
        "__wrapped__": controller,  # so that errors name its place
    }))


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """The result of a simulation.

    Example:
        >>> import greenroof_ros as gr
        >>> result = gr.simulate("onoff", hours=1)
        >>> result
        <Result: onoff, 60 min from 2021-07-07T02:00-05:00>
        >>> round(result.metrics["pumped_m3"], 3)
        0.735
        >>> result.trajectory.height
        3601

    Attributes:
        run: the run that was simulated.
        summary: the content of ``summary.json`` as written by ``greenroof simulate``.
        ticks: the trajectory as arrays; :attr:`trajectory` contains it as a table.
    """

    run: Run
    summary: Mapping[str, Any]
    ticks: Trajectory

    def __repr__(self) -> str:
        """Return the controller, the length and the start of the run as text."""
        length = duration(self.run.steps * self.run.site.tau)
        return f"<Result: {self.run.controller.name}, {length} from {to_minutes(self.run.start)}>"

    @cached_property
    def metrics(self) -> dict[str, float]:
        """The metrics, under their names in ``summary.json``, which end in their units.

        Example:
            >>> import greenroof_ros as gr
            >>> gr.simulate("onoff", hours=1).metrics["pump_starts"]
            2
        """
        return {
            metric.name: self.summary[metric.name]
            for metric in METRICS if metric.name in self.summary
        }

    @cached_property
    def trajectory(self) -> polars.DataFrame:
        """The trajectory, with a row for every tick 0..N, as a polars data frame.

        ``.to_pandas()`` converts it to pandas, if pandas and pyarrow are installed. The columns are
        the same as in ``greenroof simulate --trajectory``, and their names end in their units:

        - ``time``: in the site's ``time_zone``, or else at the UTC offset of the run's start (in
          UTC if that offset is not in whole hours)
        - ``time_s``: time since the start
        - ``cistern_m3``, ``roof_m3``: water volumes x1 and x2
        - ``cistern_level_m``, ``roof_level_m``: water depths; bags contain the readings of the
          sensors instead, which differ if the roof's sensor has errors
        - ``precipitation_m_per_s``: rain
        - ``evapotranspiration_m3_per_s``: evapotranspiration from the whole bed if the plants do
          not lack water
        - ``command``: share of the pumps' maximum flow (1)
        - ``pump_flow_m3_per_s``: flow from the cistern to the roof
        - ``outflow_m3_per_s``: flow from the cistern to the sewer
        - ``drainage_m3_per_s``: drainage from the roof
        - ``frost``: 1 during frost, otherwise 0
        - ``drainage_layer_m3``: water volume in the drainage layer of field-capacity soil
        - ``outlet_command``, ``low_outlet_flow_m3_per_s``: opening of a valve on the low outlet
          (1), and the part of the outflow through it
        - ``mains_flow_m3_per_s``: flow of mains water into the cistern, if the site has any
        - ``wet``: 1 in wet weather, otherwise 0

        The flows in the last row are not applied, because the run ends in the state that this row
        shows.

        Raises:
            ConfigurationError: if polars is not installed.

        Example:
            >>> import greenroof_ros as gr
            >>> frame = gr.simulate("onoff", hours=1).trajectory
            >>> frame["time", "command"].row(0)[1], frame.height
            (1.0, 3601)
        """
        return make_table(self.run.site, self.ticks)

    @cached_property
    def events(self) -> polars.DataFrame:
        """The rain events, one per row, with the discharge of each to the sewer.

        Events are separated by at least the site's ``event_separation`` without rain, by default
        six hours. ``volume_reduction`` and ``peak_reduction`` compare the discharge in wet weather
        with that from the same area without a green roof and a cistern. The columns are ``start``,
        in the time zone of :attr:`trajectory`, and the fields of
        :class:`greenroof_ros.physics.storm_water.Event`.

        Raises:
            ConfigurationError: if polars is not installed.

        Example:
            >>> import greenroof_ros as gr
            >>> gr.simulate("onoff", hours=36).events["rain_mm"].round(1).to_list()
            [5.9, 21.6]
        """
        zone = self.run.site.time_zone or zone_name(self.run.start)
        frame = make_frame(self.summary["events"], schema={
            "start": str, **dict.fromkeys(Event._fields, float), "complete": bool,
        })
        return frame.with_columns(
            frame["start"].str.to_datetime(time_unit="us", time_zone="UTC")
            .dt.convert_time_zone(zone)
        )

    def plot(self, start: Time = None, end: Time = None) -> altair.VConcatChart:
        """Return a chart of rain, roof and cistern level, pump flow, and any flow to the sewer.

        At a site with a valve, it includes the valve's opening. A notebook shows the chart as a
        picture. ``.save("run.png")`` writes it to a file, which can also be .svg or .html
        (``inline=True`` for a page that needs no internet connection). For a long run, the chart
        contains the smallest and the largest value in each of about 250 intervals.

        Args:
            start: beginning of the chart, at the UTC offset of the run's start unless it has its
                own; by default that of the run.
            end: end of the chart; by default that of the run.

        Raises:
            ConfigurationError: if a time is invalid or outside the run, or if altair is not
                installed.

        Example:
            >>> import greenroof_ros as gr
            >>> chart = gr.simulate("onoff", hours=1).plot()
            >>> len(chart.vconcat)
            4
        """
        return Comparison({self.run.controller.name: self}).plot(start, end)

    def save(self, directory: str | Path) -> Path:
        """Write a run directory as ``greenroof simulate --trajectory`` does, and return its path.

        ``greenroof report DIRECTORY`` reads it.

        Args:
            directory: a new or empty directory.

        Raises:
            ConfigurationError: if the directory is not empty, or if polars is not installed.
            OSError: if the directory cannot be written to.

        Example:
            >>> import tempfile, greenroof_ros as gr
            >>> with tempfile.TemporaryDirectory() as directory:
            ...     path = gr.simulate("onoff", hours=1).save(directory)
            ...     sorted(file.name for file in path.iterdir())
            ['configuration', 'events.csv', 'summary.json', 'trajectory.parquet']
        """
        content = self.ticks.to_parquet()
        with rename_keys({"--output": "directory"}):
            made = make_run_directory(Path(directory), self.run.controller.name)
        write_configuration(made, self.run, {})
        (made / TRAJECTORY).write_bytes(content)
        write_summary(self.summary, made)
        return made


def simulate(controller: str | type | Function = "onoff", **inputs: Any) -> Result:
    """Simulate a run without ROS, with the same results as ``greenroof simulate``.

    Args:
        controller: ``"mpc"``, ``"onoff"``, ``"anticipating_onoff"``, ``"lookahead"`` or
            ``"package.module:Class"``; a class as described under "Your controller" in the
            documentation; or a function of (state, forecast) that returns the command, the share of
            the pumps' maximum flow from 0 to 1, or (command, outlet) with the opening of the valve
            from 0 to 1. ``state`` has the attributes time, cistern_level and roof_level (m),
            cistern and roof (m3), and the site. ``forecast`` has the attributes rain (m/s),
            evapotranspiration (m3/s) and the ends of its steps (s); for a function, the parameter
            ``horizon`` (h, 24 by default) is the length of the forecast. In frost, a function is
            not called, and the valve keeps its position.
        inputs: the inputs below and the controller's parameters, by name; None for the default.

            - ``site``: a site file, or a site from ``gr.read_site``; by default the paper's site.
            - ``weather``: a file name, a glob pattern, a list of these, or a polars or pandas data
              frame with hourly rows and the columns of a weather file: ``time`` (or an index of
              times), ``precipitation [mm/h]`` and others. The default is the paper's weather.
            - ``start``: time of the first tick, ISO 8601, a datetime or a date; without an offset
              from UTC, it is wall-clock time in the site's ``time_zone``, or else in the weather's
              zone or offset. The default is the start of the paper's window,
              2021-07-07T02:00-05:00.
            - ``hours``: length of the run (h); by default N of the site file, 12 h.
            - ``forecast``: ``"perfect"``, ``"errors"``, ``"ensemble"``, or the path of archived
              forecasts. ``forecast_skill``, ``forecast_seed``, ``forecast_members`` and
              ``forecast_delay`` (h) correspond to the options of the command.
            - ``initial``: ``"low-low"``, ``"high-low"`` or ``"high-high"`` from Table II of the
              paper, ``"site"`` for the state in the site file, or the volumes in the cistern and on
              the roof (m3). The default is the state in the site file, or low-low if the file
              contains none.
            - ``evapotranspiration``: ``"fao56"``, ``"hargreaves"``, ``"monthly"``, or the name of
              the weather column that contains it. By default this column is used or, if it is
              missing, the first of these three methods for which the weather contains the required
              data.
            - ``gaps``: ``"refuse"``, or ``"fill"`` to fill long gaps in the weather.
            - ``roof_noise`` and ``roof_offset`` of the roof's level sensor (m), ``noise_seed``,
              ``pump_min_on`` and ``pump_min_off`` (s): by default 0, as in the paper.
            - ``trajectory_every``: time between the ticks that the trajectory contains (s); the
              last tick is always included. By default the trajectory contains all ticks; ten
              million ticks occupy a gigabyte.
            - parameters of the controller, such as ``weight=0.01``.

    Returns:
        The metrics and the trajectory, with methods that draw and save them.

    Raises:
        ConfigurationError: if an input is invalid; the message names the input and states what
            would be right.

    Warns:
        UserWarning: for each note that the command would print before the results, for example
            about weather from a distant location, or assumptions about the weather.

    Example:
        >>> import greenroof_ros as gr
        >>> result = gr.simulate("onoff", level=0.9, hours=2)
        >>> print(f"{result.metrics['pumped_m3']:.2f} m3 pumped")
        0.43 m3 pumped
        >>> dry = lambda state, forecast: 1.0 if state.roof_level < 0.04 else 0.0
        >>> gr.simulate(dry, hours=2).metrics["pump_starts"]
        2
    """
    every_s = inputs.pop("trajectory_every", None) or 0.0
    run = build_run(make_inputs(choose_controller(controller), inputs))
    return simulate_run(run, run.count_ticks_between(every_s))


def simulate_run(run: Run, every: int = 1) -> Result:
    """Simulate a run, and keep every n-th tick of its trajectory."""
    instance = run.make_controller()
    if isinstance(instance, FunctionController):
        instance.start = run.start
    made, ticks = loop.simulate(run, instance, every)
    assert ticks is not None
    return Result(run, made, ticks)


@dataclass(frozen=True, eq=False)
class Comparison:
    """The results of several controllers.

    Attributes:
        results: results of the controllers, by name.
    """

    results: Mapping[str, Result]

    @property
    def table(self) -> polars.DataFrame:
        """The metrics of all controllers, one row each, under their names in ``summary.json``.

        Raises:
            ConfigurationError: if the runs differ in length, or if polars is not installed.

        Example:
            >>> import greenroof_ros as gr
            >>> table = gr.compare({"on/off": "onoff", "MPC": "mpc"}, hours=0.1).table
            >>> table["controller", "pump_starts"].rows()
            [('on/off', 1), ('MPC', 1)]
        """
        if len({each.run.steps * each.run.site.tau for each in self.results.values()}) > 1:
            raise ConfigurationError("must have the same length in a table", key="all runs")
        return make_frame([
            {"controller": name, **result.metrics} for name, result in self.results.items()
        ])

    def plot(self, start: Time = None, end: Time = None) -> altair.VConcatChart:
        """Return a chart like that of :meth:`.Result.plot`, with a line for each controller.

        If the sites differ, the chart contains no lines for the target and the cistern levels.

        Raises:
            ConfigurationError: if altair is not installed.

        Example:
            >>> import greenroof_ros as gr
            >>> chart = gr.compare({"on/off": "onoff", "MPC": "mpc"}, hours=0.1).plot()
            >>> len(chart.vconcat)
            4
        """
        with require_extra("study"):
            from greenroof_ros.analysis.report.figures import overlay_simulations
        return overlay_simulations({
            name: (result.run.site, result.ticks.between(start, end))
            for name, result in self.results.items()
        })


def compare(controllers: Mapping[str, str | type | Function | Result], **inputs: Any) -> Comparison:
    """Simulate several controllers with the same inputs.

    Args:
        controllers: controllers, keyed by their names in the table and the chart. A :class:`Result`
            is used unchanged, so controllers can have different parameters.
        inputs: inputs of :func:`simulate`, which apply to all controllers.

    Returns:
        The results, with a common table and a common chart.

    Raises:
        ConfigurationError: if an input is invalid.

    Example:
        >>> import greenroof_ros as gr
        >>> compared = gr.compare({"on/off": "onoff", "fills to 90 %": gr.simulate(
        ...     "onoff", level=0.9, hours=1)}, hours=1)
        >>> compared.table["controller", "pump_starts"].rows()
        [('on/off', 2), ('fills to 90 %', 2)]
    """
    return Comparison({
        name: each if isinstance(each, Result) else simulate(each, **inputs)
        for name, each in controllers.items()
    })


def make_table(site: Site, ticks: Trajectory) -> polars.DataFrame:
    """Return a trajectory as a table with the columns of :attr:`Result.trajectory`."""
    frame = ticks.to_frame()
    # Not divided by polars, which multiplies by the reciprocal and gets other bits than the plant.
    levels = {"cistern_level_m": ticks.cistern / site.a1, "roof_level_m": ticks.roof / site.a2}
    if site.time_zone is not None:
        frame = frame.with_columns(frame["time"].dt.convert_time_zone(site.time_zone))
    frame = frame.with_columns(**levels)
    order = (column.name for column in COLUMNS if column.name in frame.columns)
    return frame.select("time", "time_s", *order)


def read_bag(path: str | Path, site: str | Path | Site | None = None) -> polars.DataFrame:
    """Read the trajectory from a bag that was recorded by a run of this package or at a real site.

    Args:
        path: a run directory (including one that :meth:`Result.save` wrote), a bag, or a single
            .mcap file.
        site: the site, or its file; by default the site file next to the bag, or else the paper's
            site.

    Returns:
        The columns of :attr:`Result.trajectory`; a recording lacks the mains flow and ``wet``.

    Raises:
        ConfigurationError: if the bag is damaged or was not recorded by this package, or if a
            required package is not installed.

    Example:
        >>> import tempfile, greenroof_ros as gr
        >>> with tempfile.TemporaryDirectory() as directory:
        ...     run = gr.simulate("onoff", hours=1).save(directory)
        ...     frame = gr.read_bag(run)
        >>> print(frame["time"][-1], round(frame["roof_level_m"][-1], 4))
        2021-07-07 03:00:00-05:00 0.0457
    """
    with require_extra("study"):
        from greenroof_ros.analysis.report.runs import read_run
    run = read_run(Path(path), Path(site) if isinstance(site, str) else site)
    if (trajectory := run.trajectory()) is None:
        raise ConfigurationError(
            "contains only results: the run wrote no trajectory", file=Path(path)
        )
    return make_table(run.site, trajectory)
