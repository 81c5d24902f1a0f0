"""Studies: many runs that differ in some of their inputs, with one table of results."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from hashlib import sha256
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from greenroof_ros.analysis.case import Case, choose_used, compute_bounds, run_case
from greenroof_ros.analysis.executors import Task, run_tasks
from greenroof_ros.analysis.store import StudyStore
from greenroof_ros.analysis.tables import COLUMNS, TOTAL, WET, check_metrics
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import unique_name
from greenroof_ros.base.processes import scratch_directory
from greenroof_ros.controllers.registry import DEFAULT, choose_class, find_controller
from greenroof_ros.forecast.choice import ForecastChoice
from greenroof_ros.forecast.issue import read_archive, write_forecasts
from greenroof_ros.physics.pump import SensorAndPump
from greenroof_ros.results.table import find_differing_keys, make_frame
from greenroof_ros.simulation.inputs import RunInputs, find_needs, make_inputs
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.site import Site
from greenroof_ros.weather.read import is_frame, read_weather, write_plain
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
        self._write_plain = functools.cache(write_plain)
        self._read_weather = functools.cache(read_weather)
        self._write_archive = functools.cache(
            lambda path, site: write_forecasts(read_archive(path, site))
        )

    def make_case(self, inputs: RunInputs, site_file: str = "site.yaml") -> Case:
        """Check a run, and return its case, without inputs that do not affect it.

        Args:
            inputs: inputs of the run.
            site_file: name of the file of a site that was read before.

        Raises:
            ConfigurationError: if the run is invalid.
        """
        if isinstance(inputs.site, Path):
            site_file = inputs.site.name
        site = inputs.read_site()
        inputs = choose_used(replace(inputs, site=site), site)
        forecast, (run, names) = inputs.forecast, self._build(inputs, site)
        weather = tuple(map(Path, names))
        if forecast.file is not None:
            path, text = forecast.file, None
            if path.is_dir():  # one file in the project's own form
                path, text = path.with_name(f"{path.name}.csv"), self._write_archive(path, site)
            names = [*names, self.add(path, text)]
            forecast = replace(forecast, file=Path(names[-1]))
        return Case(
            replace(
                inputs, weather=weather, forecast=forecast, start=run.start.isoformat(),
                hours=run.steps * site.tau / 3600, evapotranspiration=run.weather.method,
                initial=run.initial, cistern=run.x1, roof=run.x2,
            ),
            site_file, {name: sha256(self.contents[name]).hexdigest() for name in names},
        )

    def _build(self, inputs: RunInputs, site: Site) -> tuple[Run, list[str]]:
        """Build a run, once for all runs with the same records, and name its weather files."""
        if inputs.forecast.file is None:  # all models need the same records
            inputs = replace(inputs, forecast=ForecastChoice())
        weather, files = inputs.weather, isinstance(inputs.weather, tuple)
        needs = find_needs(inputs.controller, inputs.parameters), inputs.parameters.get("horizon")
        others = replace(
            inputs, weather=(), parameters={}, controller=find_controller(DEFAULT),
            sensor_and_pump=SensorAndPump(),
        )
        key = needs, weather if files else id(weather), repr(others)
        if key not in self.runs:
            if files:
                name, plain = weather[0].stem, self._write_plain(weather, site.place)
                inputs = replace(inputs, weather=self._read_weather(
                    weather, site.place, inputs.evapotranspiration, inputs.gaps, inputs.climate
                ))
            run = inputs.build()
            if not files and run.records is not None:
                name, plain = "weather", write_records(run.records, "Written from a data frame.")
            self.runs[key] = run, [*map(self.add, run.weather.files)] if plain is None else [
                self.add(Path(f"{name}.csv"), plain)
            ]
        return self.runs[key]

    def add(self, path: Path, text: str | None = None) -> str:
        """Add a file, and return its name in the study.

        The name is the file's own name, preceded by the folder's name if another file has the same
        name.

        Args:
            path: path of the file.
            text: text that replaces the file's content.
        """
        path = path.resolve()
        key = path, path.read_bytes() if text is None else text.encode()
        if key not in self._names:
            used = self.contents.keys() | {"grid.yaml", "study.json", "weather.yaml"}
            name = path.name if path.name not in used else f"{path.parent.name}-{path.name}"
            self._names[key] = unique_name(Path(name), used)
            self.contents[self._names[key]] = key[1]
        return self._names[key]


def study(
    cases: Any, executor: Executor | None = None, *, output: str | os.PathLike[str] | None = None,
    show: Sequence[str] = (), trajectory_every: float | None = None, jobs: int | None = None,
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
        show: metrics that the study is about, such as ``["wet_discharge_m3"]``: their minimum
            possible values are computed, and a report shows them first.
        trajectory_every: time between the samples of each run's trajectory in ``output`` (s), 0 for
            every time step; None to keep none.
        jobs: number of threads, and of processes; by default one per core.

    Returns:
        The columns in which the cases differ, followed by the metrics, and by a column ``error`` if
        a run failed.

    Raises:
        ConfigurationError: if an input of a case or a metric is invalid, or ``output`` is not
            empty.

    Example:
        >>> import greenroof_ros as gr
        >>> table = gr.study({"controller": "onoff", "fraction": [0.5, 1.0], "hours": 0.1})
        >>> table["fraction", "pump_starts"].rows()
        [(0.5, 1), (1.0, 1)]
    """
    check_metrics(show)
    files, made = Files(), dict[str, Case]()
    for number, keywords in enumerate(_list_cases(cases), start=1):
        given = {name: value for name, value in keywords.items() if value is not None}
        kind = given.pop("controller", DEFAULT)
        choice = choose_class(kind) if isinstance(kind, type) else find_controller(str(kind))
        try:
            case = files.make_case(make_inputs(choice, given))
        except ConfigurationError as error:
            raise ConfigurationError(f"{error} (case {number})") from error
        made[case.identity] = case
    with scratch_directory() as scratch:
        store = StudyStore(
            scratch / "study" if output is None else Path(output), [*made.values()],
            files.contents, trajectory_every=trajectory_every, show=show,
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
    bounded = {
        case.plain.identity: case for case in store.cases
        if TOTAL in store.show or (WET in store.show and case.site.low_outlet_valve)
    }
    tasks = [
        Task(compute_bounds, (case, store.show)) for identity, case in bounded.items()
        if identity not in store.bounds
    ]
    # The longest first, or at the end one core may have a long run while the others are idle.
    left = [case for case in store.cases if case.identity not in store.results]
    left.sort(key=lambda case: (
        not case.inputs.controller.ensemble, not case.inputs.controller.outputs,
        -case.hours, case.inputs.weather, case.inputs.start,
    ))
    tasks += [Task(run_case, (case, store.trajectory_every), case.is_compiled) for case in left]

    def receive(task: Task, result: Any, error: Exception | None) -> None:
        case = task.arguments[0]
        if error is not None:
            reason, what = str(error) or type(error).__name__, "no bound"
            if task.function is run_case:  # a missing bound is no failure
                what, store.failures[case.identity] = "failed", reason
            tell(f"{what}: {store.name(case)}, run {case.identity}: {reason}")
        elif task.function is run_case:
            store.write_outcome(case, result)
        else:
            store.write_bound(case.plain.identity, result)

    if tasks:
        run_tasks(
            tasks, store.inputs, receive, executor=executor, jobs=jobs, progress=progress
        )
