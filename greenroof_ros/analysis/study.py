"""Studies: many runs that differ in some of their inputs, with one table of results."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from dataclasses import replace
from hashlib import sha256
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from greenroof_ros.analysis.case import Case, drop_unused, run_case
from greenroof_ros.analysis.executors import Task, run_tasks
from greenroof_ros.analysis.store import StudyStore
from greenroof_ros.analysis.tables import COLUMNS
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import unique_name
from greenroof_ros.base.processes import scratch_directory
from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.controllers.registry import DEFAULT, choose_class, find_controller
from greenroof_ros.forecast.choice import ForecastChoice
from greenroof_ros.forecast.issue import read_archive, write_forecasts
from greenroof_ros.physics.compiled import note_if_slow
from greenroof_ros.physics.sensor_and_pump import SensorAndPump
from greenroof_ros.results.forked_polars import make_frame
from greenroof_ros.results.table import find_differing_keys
from greenroof_ros.simulation.inputs import RunInputs, find_needs, make_inputs
from greenroof_ros.simulation.run import Run, count_ticks
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site
from greenroof_ros.weather.frame import is_frame
from greenroof_ros.weather.read import read_weather, write_plain
from greenroof_ros.weather.records import write_records

if TYPE_CHECKING:
    import polars


class Files:
    """The input files of a study, each of which is read once, and the cases that use them.

    Attributes:
        contents: contents of the files, by names that are unique in the study.
        runs: a run for each record that the cases need, with the names of its weather files.
    """

    def __init__(self) -> None:
        self.contents = dict[str, bytes]()
        self.runs = dict[tuple[object, ...], tuple[Run, list[str]]]()
        self._names = dict[tuple[Path, bytes], str]()
        self._read_bytes = functools.cache(Path.read_bytes)
        self._write_plain = functools.cache(write_plain)
        self._read_site = functools.cache(read_site)
        self._read_weather = functools.cache(read_weather)
        self._write_archive = functools.cache(_write_archive)

    def make_case(
        self, inputs: RunInputs, site_file: str = "site.yaml", block: float | None = None
    ) -> Case:
        """Check a run, and return its case, without inputs that do not affect it.

        Args:
            inputs: inputs of the run.
            site_file: name of the file of a site that was read before.
            block: time block of the bound, as in a case.

        Raises:
            ConfigurationError: if the run is invalid.
        """
        if isinstance(inputs.site, Path):
            site_file, inputs = inputs.site.name, replace(inputs, site=self._read_site(inputs.site))
        site, weather = inputs.site, inputs.weather
        assert isinstance(site, Site)
        complete = functools.partial(inputs.controller.complete_parameters, site)
        inputs = drop_unused(inputs, complete(inputs.parameters))
        parameters, forecast = complete(inputs.parameters), inputs.forecast
        if block:
            count_ticks(site, block, "bound_block", unit_s=1.0)
        run, names = self._build(replace(
            inputs, parameters=parameters,
            # Forecasts with errors need the same records as perfect forecasts.
            forecast=forecast if forecast.file else ForecastChoice(),
        ), site)
        weather = tuple(map(Path, names))
        if forecast.file is not None:
            names = [*names, self._add_forecast(forecast.file, site)]
            forecast = replace(forecast, file=Path(names[-1]))
        return Case(
            replace(
                inputs, weather=weather, parameters=parameters, forecast=forecast,
                start=run.start.isoformat(), hours=run.steps * site.tau / 3600,
                evapotranspiration=run.weather.method, initial=run.initial, cistern=run.x1,
                roof=run.x2,
            ),
            site_file, {name: sha256(self.contents[name]).hexdigest() for name in names},
            run.steps, block,
        )

    def _build(self, inputs: RunInputs, site: Site) -> tuple[Run, list[str]]:
        """Build a run, once for all runs with the same records, and name its weather files."""
        weather, controller = inputs.weather, inputs.controller
        needs = find_needs(controller, inputs.parameters), inputs.parameters.get("horizon")
        others = replace(
            inputs, weather=(), parameters={}, controller=find_controller(DEFAULT),
            sensor_and_pump=SensorAndPump(),
        )
        files = isinstance(weather, tuple)
        key = needs, weather if files else id(weather), repr(others)
        if key not in self.runs:
            if files:
                weather = self._read_weather(
                    weather, site.place, inputs.evapotranspiration, inputs.gaps
                )
            run, plain = replace(inputs, weather=weather).build(), None
            name = Path(f"{run.weather.files[0].stem}.csv" if files else "weather.csv")
            if files:
                plain = self._write_plain(inputs.weather, site.place)
            elif run.records is not None:
                plain = write_records(run.records, "Written from a data frame.")
            self.runs[key] = run, [*map(self.add, run.weather.files)] if plain is None else [
                self.add(name, plain.encode())
            ]
        return self.runs[key]

    def add(self, path: Path, content: bytes | None = None) -> str:
        """Add a file, and return its name in the study.

        The name is the file's own name, preceded by the folder's name if another file has the same
        name.

        Args:
            path: path of the file.
            content: content that replaces the file's own.
        """
        path = path.resolve()
        key = path, self._read_bytes(path) if content is None else content
        if key not in self._names:
            used = self.contents.keys() | {"grid.yaml", "study.json", "weather.yaml"}
            name = path.name if path.name not in used else f"{path.parent.name}-{path.name}"
            self._names[key] = unique_name(Path(name), used)
            self.contents[self._names[key]] = key[1]
        return self._names[key]

    def _add_forecast(self, path: Path, site: Site) -> str:
        """Add a file of forecasts, or a directory as a single file in the project's own format."""
        if not path.is_dir():
            return self.add(path)
        text = self._write_archive(path, site)
        return self.add(path.with_name(f"{path.name}.csv"), text.encode())


def _write_archive(path: Path, site: Site) -> str:
    return write_forecasts(read_archive(path, site))


def study(
    cases: Any, executor: Executor | None = None, *, output: str | os.PathLike[str] | None = None,
    bound_block: float | None = None, trajectory_every: float | None = None,
    jobs: int | None = None,
) -> polars.DataFrame:
    """Simulate many runs, and return a table with a row for each.

    On/off control and the policies of the valve run in threads, other controllers in processes. As
    with any processes of Python, a script must call this below ``if __name__ == "__main__":``.

    Args:
        cases: keyword arguments of ``gr.simulate``: a mapping in which every list stands for
            alternatives, all of which are combined; a list of mappings; or a polars or pandas data
            frame with a row for each run. A controller is a name, ``package.module:Class`` or a
            class. Equal cases are simulated once.
        executor: executor that runs everything instead, such as one of ``concurrent.futures``, or
            ``get_executor()`` of a ``dask.distributed.Client`` for the workers of a cluster, which
            must see the directory ``output``.
        output: directory for the results as of ``greenroof study``, which ``greenroof report``
            reads. If it contains an interrupted study of the same cases, the study is continued.
        bound_block: duration for which one variable of the minimum possible deviation applies (s),
            0 for only the minimum discharge of a valve; None to compute no minimum.
        trajectory_every: time between the samples of each run's trajectory in ``output`` (s), 0 for
            every time step; None to keep none.
        jobs: number of threads, and of processes; by default one per core.

    Returns:
        The columns in which the cases differ, followed by the metrics, and by a column ``error`` if
        a run failed.

    Raises:
        ConfigurationError: if an input of a case is invalid, or ``output`` is not empty.

    Example:
        >>> import greenroof_ros as gr
        >>> table = gr.study({"controller": "onoff", "fraction": [0.5, 1.0], "hours": 0.1})
        >>> table["fraction", "pump_starts"].rows()
        [(0.5, 1), (1.0, 1)]
    """
    files, made = Files(), dict[str, Case]()
    for number, keywords in enumerate(_list_cases(cases), start=1):
        given = {name: value for name, value in keywords.items() if value is not None}
        kind = given.pop("controller", DEFAULT)
        choice = choose_class(kind) if isinstance(kind, type) else find_controller(str(kind))
        try:
            case = files.make_case(make_inputs(choice, given), block=bound_block)
        except ConfigurationError as error:
            raise ConfigurationError(f"{error} (case {number})") from error
        made[case.identity] = case
    with scratch_directory() as scratch:
        store = StudyStore(
            scratch / "study" if output is None else Path(output), [*made.values()],
            files.contents, trajectory_every=trajectory_every,
        )
        run_study(store, executor=executor, jobs=jobs)
        rows = store.write_table()
    names, about = dict.fromkeys(key for row in rows for key in row), [*rows[0]].index("status")
    differing = find_differing_keys([dict([*row.items()][1:about]) for row in rows])
    results = [name for name in names if name in COLUMNS or "bound" in name]
    failed = ["error"] * any(row["error"] for row in rows)
    return make_frame(rows, infer_schema_length=None).select(differing + results + failed).rename(
        lambda name: name if (plain := name.removeprefix("parameter:")) in results else plain
    )


def _list_cases(cases: Any) -> Iterable[Mapping[str, Any]]:
    if isinstance(cases, Mapping):
        lists = (each if isinstance(each, list) else [each] for each in cases.values())
        return (dict(zip(cases, values, strict=True)) for values in product(*lists))
    if is_frame(cases):  # pandas has several values that stand for a missing one
        rows = cases.to_dicts() if hasattr(cases, "to_dicts") else cases.to_dict("records")
        return ({key: each for key, each in row.items() if each == each} for row in rows)
    return list(cases)


def run_study(
    store: StudyStore, *, executor: Executor | None = None, jobs: int | None = None,
    progress: Callable[[float], None] = lambda share: None,
    tell: Callable[[str], None] = lambda text: None,
) -> None:
    """Run the cases of a study that are not stored yet, and compute their bounds.

    Args:
        store: the study.
        executor: as for :func:`study`.
        jobs: as for :func:`study`.
        progress: function that receives the completed share at least every half second.
        tell: function that receives a sentence for each run that failed and each missing bound.

    Raises:
        WorkersLostError: if the workers were lost.
    """
    tasks = {
        identity: Task(function, (case,))
        for case in store.cases for identity, function in case.bounds.items()
        if identity not in store.bounds
    }
    # The longest first, or at the end one core may have a long run while the others are idle.
    for case in sorted(store.cases, key=lambda case: (
        not case.inputs.controller.ensemble, not case.inputs.controller.outputs,
        -case.hours, case.inputs.weather, case.inputs.start,
    )):
        if case.identity not in store.results:
            tasks[f"run {case.identity}"] = Task(
                run_case, (case, store.trajectory_every), case.is_compiled
            )
    identities = {id(task): identity for identity, task in tasks.items()}
    note_if_slow(sum(
        task.arguments[0].ticks for task in tasks.values()
        if task.arguments[0].inputs.controller.kind is OnOff
    ))

    def receive(task: Task, result: Any, error: Exception | None) -> None:
        case, identity = task.arguments[0], identities[id(task)]
        if error is not None:
            reason, what = str(error) or type(error).__name__, "no bound"
            if task.function is run_case:  # a missing bound is no failure
                what, store.failures[case.identity] = "failed", reason
            tell(f"{what}: {store.name(case)}, run {case.identity}: {reason}")
        elif task.function is run_case:
            store.write_outcome(case, result)
        else:
            store.write_bound(identity, result)

    if tasks:
        run_tasks(
            tasks.values(), store.inputs, receive, executor=executor, jobs=jobs, progress=progress
        )
