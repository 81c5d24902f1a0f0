"""Access to the package's own config/ and msg_defs/, and reading and writing of files."""

from __future__ import annotations

import glob
import gzip
import math
import os
import re
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

import yaml

from greenroof_ros.base.errors import ConfigurationError

# libyaml is ten times as fast, and every process reads the interface when it starts. ruamel.yaml
# knows lines of keys in pure Python only (140 ms for topics.yaml instead of 2 ms); its C loader
# is five times slower than PyYAML's, and deep nesting crashes the interpreter.
_BaseLoader: Any = getattr(yaml, "CBaseLoader", yaml.BaseLoader)


class _Loader(_BaseLoader):  # type: ignore[misc]
    def resolve(self, *_: object) -> str:
        """Give no node a tag, except the tags in the text."""
        return ""


_SHARED = "msg_defs/topics.yaml", "config/site.yaml"


def shared_directory() -> Path:
    """Return the directory that contains ``config/`` and ``msg_defs/``.

    In a checkout, or an editable installation of a checkout, this directory is the checkout itself.
    Otherwise it is ``share/greenroof_ros`` in the installation prefix of the package (a virtual
    environment, ``~/.local``, or colcon's ``install/greenroof_ros``).
    """
    package = Path(__file__).resolve().parent
    for parent in package.parents:
        for place in (parent / "share/greenroof_ros", parent):
            if all(Path(place, file).is_file() for file in _SHARED):
                return place
    raise ConfigurationError(
        "greenroof_ros was installed without its directory share/greenroof_ros (config, "
        "msg_defs); reinstall it with pip or colcon",
        file=package,
    )


def default_site_file() -> Path:
    """Return the path of the paper's site file, the default of all commands and nodes."""
    return shared_directory() / "config" / "site.yaml"


_SHIPPED = "", "config", "config/weather", "config/forecasts"


def find_shipped(file: Path) -> Path:
    """Return the file or, if it does not exist, the package's own file of this name or path."""
    shipped = (shared_directory() / folder / file for folder in _SHIPPED)
    return file if file.exists() else next(filter(Path.is_file, shipped), file)


def state_directory() -> Path:
    """Return the user's directory for the package's state, ``~/.local/state/greenroof_ros``."""
    from platformdirs import user_state_path  # few commands need it

    return user_state_path("greenroof_ros", appauthor=False)


def unique_name(file: Path, existing: Container[str]) -> str:
    """Return the file's name, with -2, -3, ... appended to the stem if the name is in use."""
    name, number = file.name, 1
    while name in existing:
        number += 1
        name = f"{file.stem}-{number}{file.suffix}"
    return name


COPIES = "GREENROOF_ROS_COPIES"
"""environment variable of a live site's nodes: the directory with copies of the files that the site
was started with, each under its full path"""


def as_started(file: Path) -> Path:
    """Return the path to read for a file: in a live site's node, the path of any copy of it.

    Because of the copy, a restarted node does not use later edits to the file. Messages name the
    original file.
    """
    copies = os.environ.get(COPIES)
    copy = Path(f"{copies}{file.absolute()}") if copies else file
    return copy if copy.exists() else file


def is_there(path: Path) -> bool:
    """Return True if the path exists, and False if it is too long for a file name."""
    return os.path.exists(path)  # noqa: PTH110 (pathlib raises an error)


def find_named(name: str, file: Path, key: str) -> list[Path]:
    """Return the files that match a name or pattern in a file.

    They are from the first directory with such files: next to the file, or in this package's
    ``config/`` or ``config/weather/``, so that a copy of a file of this package works unchanged.

    Args:
        name: the name or pattern.
        file: the file that contains the name.
        key: key of the name, for the error.

    Raises:
        ConfigurationError: if no directory contains such a file.
    """
    config = shared_directory() / "config"
    places = file.parent, config, config / "weather"
    for place in places:
        if is_there(place / name):
            return [place / name]
        if found := sorted(glob.glob(str(place / name))):  # noqa: PTH207
            return [Path(each) for each in found]
    where = ", ".join(str(place.resolve()) for place in places)
    raise ConfigurationError(f"there is no {name} in {where}", key=key)


MAX_BYTES = 100_000_000
"""Maximum size of a user's file (bytes): 100 years of hourly weather, three years of a record by
the minute, or a year of hourly forecast runs with one member. So no file exhausts the memory."""


def read_lines(path: Path, encoding: str = "utf-8") -> Iterator[str]:
    """Read a text file line by line, without any byte order mark at the beginning.

    A file named ``.gz`` is unpacked as it is read.

    An invalid line is rejected as soon as it is read, so an error near the beginning of a large
    file is reported immediately.

    Yields:
        Each line, with a line feed at its end, whichever line ending the file has.

    Raises:
        ConfigurationError: if the file cannot be read, is too large or empty, or contains a line
            that is not text in the encoding.
    """
    source = as_started(path)
    if source.exists() and not source.is_file():
        raise ConfigurationError("must be a regular file", file=path)
    blank, number = True, 1
    try:
        # Bytes that are not text become surrogates, so that the line of the first one is known.
        opened = gzip.open if source.suffix == ".gz" else open
        with opened(source, "rt", encoding=encoding, errors="surrogateescape") as stream:
            size = os.fstat(stream.fileno()).st_size
            if size > MAX_BYTES:
                raise ConfigurationError(
                    f"is {size / 1e6:.0f} MB in size, but the limit is {MAX_BYTES / 1e6:g} MB: "
                    "delete the data that no run needs, or split the file (weather can be given "
                    "as several files, and forecasts as a directory of files)", file=path,
                )
            for number, line in enumerate(stream, start=1):
                line.encode()
                if "\0" in line:
                    raise UnicodeError
                if number == 1:
                    line = line.removeprefix("\ufeff")
                blank = blank and not line.strip()
                yield line
    except (OSError, EOFError) as error:
        why = getattr(error, "strerror", None) or error
        raise ConfigurationError(f"cannot be read: {why}", file=path) from error
    except UnicodeError:
        raise ConfigurationError(
            f"is not text in {encoding.upper()}: unpack a compressed file, save a table as CSV in "
            "UTF-8, or state the encoding: of a weather file in its description, which "
            "greenroof weather FILE --describe prints", file=path, line=number,
        ) from None
    if blank:
        raise ConfigurationError("is empty", file=path)


def read_text(path: Path) -> str:
    """Return the text of a file; see :func:`read_lines`."""
    return "".join(read_lines(path))


# Maximum size of a YAML file (characters): the metadata of a bag of 3,000 files. And the number of
# values that its aliases may add: a few lines of nested aliases would make billions.
_MAX_YAML, _MAX_ALIASED = 1_000_000, 10_000
# Longer integers (digits) are read as floating-point numbers: no quantity needs so many digits.
_MAX_DIGITS = 20
_WORDS = {
    "yes": True, "true": True, "on": True, "no": False, "false": False, "off": False,
    "null": None, "~": None, "": None,
    ".nan": math.nan, ".inf": math.inf, "+.inf": math.inf, "-.inf": -math.inf,
}
_NUMBER = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_HEXADECIMAL = re.compile(r"0x[0-9A-Fa-f]{1,16}")


class YamlMapping(dict[str, Any]):
    """A mapping from a YAML file, with the line number of every key."""

    def __init__(
        self, values: Mapping[str, Any] | None = None, lines: Mapping[str, int] | None = None
    ) -> None:
        super().__init__(values or {})
        self.lines = {**(lines or {})}


def parse_plain(text: str) -> Any:
    """Return the value of an unquoted text: numbers as in YAML 1.2, and yes and no as in 1.1."""
    if (word := text.lower()) in _WORDS:
        return _WORDS[word]
    if _HEXADECIMAL.fullmatch(text):
        return int(text, 16)
    if not _NUMBER.fullmatch(text):
        return text
    whole = len(text) <= _MAX_DIGITS and not set(text) & {*".eE"}
    return int(text) if whole else float(text)


def check_private(file: Path) -> None:
    """Check that only one user can read or change a file with a secret; the file may be missing.

    Raises:
        ConfigurationError: if other users can read or change the file.
    """
    with suppress(OSError):  # the error is reported when it is read
        if as_started(file).stat().st_mode & 0o077:
            raise ConfigurationError(
                "can be read or changed by other users: protect the file with chmod 600, and "
                "replace the secret in it if somebody might have read it", file=file,
            )


def read_yaml(path: Path) -> YamlMapping:
    """Read a YAML file whose top level is a mapping.

    Raises:
        ConfigurationError: if the file cannot be read, if its top level is not a mapping, or if
            :func:`parse_yaml` raises one.
    """
    content = parse_yaml(read_text(path), path)
    if not isinstance(content, YamlMapping):
        raise ConfigurationError("must contain 'key: value' lines", file=path)
    return content


def parse_yaml(text: str, path: Path) -> Any:
    """Return the value of a YAML text, with every mapping as a :class:`YamlMapping`.

    Args:
        text: the YAML text.
        path: the file that contains the text, for errors.

    Raises:
        ConfigurationError: if the text is not valid YAML, is too long or too deeply nested,
            contains a tag, repeats a key in a mapping, or adds too many values through aliases.
    """
    if len(text) > _MAX_YAML:
        raise ConfigurationError(f"is longer than {_MAX_YAML / 1e6:g} MB", file=path)
    try:
        node = yaml.compose(text, Loader=_Loader)
        return None if node is None else _read_node(node, iter(range(len(text) + _MAX_ALIASED)))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        problem = ", ".join(filter(None, (error.context, error.problem)))
        if mark and text[mark.index:mark.index + 1] == "\t":
            problem = "indent with spaces, not tabs"
        line = mark.line + 1 if mark else None
        raise ConfigurationError(f"is not valid YAML: {problem}", file=path, line=line) from error
    except (yaml.YAMLError, RecursionError) as error:
        raise ConfigurationError(f"is not valid YAML: {error}", file=path) from error


def _read_node(node: yaml.Node, left: Iterator[int]) -> Any:
    """Return the value of a node; an alias is read again wherever it stands.

    Args:
        node: the node.
        left: an item for each value that may still be read.
    """
    if next(left, None) is None:
        raise _at(node, f"its aliases (*NAME) add more than {_MAX_ALIASED} values")
    if node.tag:
        raise _at(node, f"values must not have tags such as {node.tag!r}")
    if isinstance(node, yaml.ScalarNode):
        return node.value if node.style in ("'", '"') else parse_plain(node.value)
    if isinstance(node, yaml.SequenceNode):
        return [_read_node(item, left) for item in node.value]
    mapping = YamlMapping()
    for key, value in node.value:
        name = key.value
        if not isinstance(key, yaml.ScalarNode) or key.tag:
            raise _at(key, "a key must be text without a tag")
        if name in mapping:
            raise _at(key, f"the key {name} appears twice, first on line {mapping.lines[name]}")
        mapping[name] = _read_node(value, left)
        mapping.lines[name] = key.start_mark.line + 1
    return mapping


def _at(node: yaml.Node, problem: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)


def claim_directory(directory: Path, is_own: Callable[[str], bool] = lambda name: False) -> None:
    """Create a command's output directory, or check that it contains nothing else.

    Args:
        directory: the directory.
        is_own: function that tells whether a file may be there, because it will be replaced.

    Raises:
        ConfigurationError: if the directory contains other files.
        OSError: if the directory cannot be written to.
    """
    directory.mkdir(parents=True, exist_ok=True)
    if others := [file.name for file in directory.iterdir() if not is_own(file.name)]:
        raise ConfigurationError(
            f"exists and is not empty: it contains {min(others)}; choose another directory",
            key="--output", value=str(directory),
        )


@contextmanager
def add_path_to_errors(path: Path) -> Iterator[None]:
    """Add a path to an OSError without one, such as an error from reading an open file.

    Raises:
        OSError: if the block raises one; the path is added to the message if it has none.
    """
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def replace_text(file: Path, text: str, *, parents: bool = False) -> None:
    """Replace the content of a file with a text; see :func:`replace_file`."""
    replace_file(file, lambda stream: stream.write(text.encode()), parents=parents)


def replace_file(file: Path, write: Callable[[BinaryIO], object], *, parents: bool = False) -> None:
    """Replace a file as a whole, so that a power cut leaves either the old or the new file.

    Args:
        file: the file; only one process at a time may replace it.
        write: function that writes the content to the open file.
        parents: True to create missing directories; use False if the file's disk may be unmounted.

    Raises:
        OSError: if the file cannot be written; the old file is then unchanged.
    """
    if parents:
        file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f".{file.name}.part")
    try:
        with add_path_to_errors(part), part.open("wb") as stream:
            write(stream)
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(file)
    except OSError:
        part.unlink(missing_ok=True)
        raise
