"""Where a report's runs come from: studies, run directories, or bags alone."""

from __future__ import annotations

from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.site import read_site
from greenroof_ros.report.bags import read_run, run_directory
from greenroof_ros.report.entries import Sources, tell_apart
from greenroof_ros.report.studies import read_study


def find_runs(paths: list[Path], site_file: Path | None) -> Sources:
    """Find the runs under some paths; their trajectories are read later, one by one.

    Args:
        paths: study directories, run directories and bags.
        site_file: the site of all bags, instead of the one that lies beside each.

    Raises:
        ConfigurationError: a path is none of these, or what it holds is wrong.
    """
    sources = Sources()
    given = read_site(site_file) if site_file is not None else None
    for path in paths:
        if not path.exists():
            raise ConfigurationError("does not exist", file=path)
        if not path.is_dir():
            raise ConfigurationError(
                "must be a directory: of a study, of a run, or a bag", file=path
            )
    names = _names([run_directory(path).resolve() for path in paths])
    for path, name in zip(paths, names, strict=True):
        if (path / "results.csv").is_file():
            if site_file is not None:
                raise ConfigurationError(
                    f"is for bags; {path} is a study and has its own sites", key="--site"
                )
            read_study(path, name, f"{name}/" if len(paths) > 1 else "", sources)
        elif (path / "runs").is_dir() or (path / "configuration" / "study.json").is_file():
            raise ConfigurationError("is a study without results.csv", file=path)
        else:
            read_run(path, name, site_file, given, sources)
    names = [run.name for run in sources.runs]
    for name in names:
        if names.count(name) > 1:
            raise ConfigurationError(f"two runs are named {name}; give each path once")
    if not sources.runs:
        raise nothing_to_show(sources)
    sources.runs = tell_apart(sources.runs)
    return sources


def nothing_to_show(sources: Sources) -> ConfigurationError:
    """Return the error of a report none of whose runs left anything to show."""
    first = sources.failed[0]
    return ConfigurationError(
        f"holds no finished run; {len(sources.failed)} failed or did not run, the first: "
        f"{first.name} {first.error}"
    )


def _names(places: list[Path]) -> list[str]:
    """Return as much of the end of each path as distinguishes it from the others."""

    def name(place: Path) -> str:
        return next(
            "/".join(place.parts[-count:])
            for count in range(1, len(place.parts) + 1)
            if all(
                other == place or other.parts[-count:] != place.parts[-count:] for other in places
            )
        )

    return [name(place) for place in places]
