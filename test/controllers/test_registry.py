"""Controllers by name and by path: parameters, files, other packages, wrong references."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from paper import PAPER_SITE, paper_run
from places import CONFIG

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.site.file import read_site


def test_without_its_solver(monkeypatch: pytest.MonkeyPatch) -> None:
    """If pip's part of the installation is missing, the error states this, without a traceback."""
    monkeypatch.setitem(sys.modules, "osqp", None)
    choice = find_controller("mpc")
    with pytest.raises(ConfigurationError, match=r"mpc.py, line \d+: Mpc.__init__: .*osqp"):
        choice.make(PAPER_SITE, choice.complete_parameters(PAPER_SITE, {}))


DUMP = """{}/onoff:
  ros__parameters:
    fraction: 0.5
    level: 1
    qos_overrides:
      /parameter_events:
        publisher:
          depth: 1000
          durability: volatile
    site_file: /runs/1/configuration/site.yaml
    start_type_description_service: true
    use_sim_time: true
"""


def test_a_dump_of_a_node(tmp_path: Path) -> None:
    """As ``ros2 param dump`` writes it; it is for the node of that namespace alone, as in ROS."""
    file, onoff = tmp_path / "dump.yaml", find_controller("onoff")
    for namespace, other in (("", "/x"), ("/x", ""), ("/x", "/x/y")):
        file.write_text(DUMP.format(namespace))
        assert onoff.read_parameters(file, namespace) == {"fraction": 0.5, "level": 1.0}
        with pytest.raises(ConfigurationError, match=f"for the node {other}/onoff; it contains"):
            onoff.read_parameters(file, other)


def test_all_sections_of_a_node_count(tmp_path: Path) -> None:
    """The last one wins, as in rcl, and an option wins over the file; 1 may be written for 1.0."""
    file = tmp_path / "mine.yaml"
    file.write_text(
        "/**:\n  ros__parameters: {use_sim_time: true, fraction: 0.5, level: 1}\n"
        "/x:\n  onoff:\n    ros__parameters: {level: 0.8}\n"
    )
    onoff = find_controller("onoff")
    assert onoff.read_parameters(file) == {"fraction": 0.5, "level": 1.0}
    assert onoff.read_parameters(file, "/x") == {"fraction": 0.5, "level": 0.8}
    run = paper_run("--controller", "onoff", "--parameters", str(file), "--level", "0.7")
    assert run.parameters == {"fraction": 0.5, "level": 0.7}


@pytest.mark.parametrize(("text", "wrong"), [
    ("mpc: {ros__parameters: {weight: 1.0}}\n", "onoff.*it contains mpc"),
    ("onoff: {ros__parameters: {level_limit: 3.0}}\n", "level_limit: is not a parameter of onoff"),
    ("/**/onoff:\n  ros__parameters:\n    weight: 1.0\n", "line 3: weight: is not a parameter"),
    ("/**/onoff:\n  ros__parameters:\n    fraction: -1.0\n", "line 3: fraction = -1.0: "),
])
def test_wrong_files(tmp_path: Path, text: str, wrong: str) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(ConfigurationError, match=f"mine.yaml.*{wrong}"):
        find_controller("onoff").read_parameters(tmp_path / "mine.yaml")


@pytest.mark.parametrize(("reference", "message"), [
    ("onof", "is unknown; did you mean onoff"), ("a b:C", "must be of the form"),
    ("package:Plant", "the node would have the same name as another node, plant"),
    ("package:RainGauge", "the node would have the same name as another node, rain_gauge"),
    ("package:Mpc", "the node would have the same name as another node, mpc"),
])
def test_wrong_references(reference: str, message: str) -> None:
    """They are refused before anything is imported."""
    with pytest.raises(ConfigurationError, match=f"controller = '{reference}': {message}"):
        find_controller(reference)


def test_a_node_is_named_after_the_class() -> None:
    """In lower case with underscores, as ROS names nodes."""
    for class_name, node in (("PControl", "p_control"), ("_MyMPC2", "my_mpc2")):
        assert find_controller(f"package.module:{class_name}").name == node


@pytest.mark.parametrize(("code", "message"), [
    ("1 / 0", "cannot be imported: ZeroDivisionError: division by zero"),
    ("class Mine: pass", "is not a controller: it lacks parameters, command"),
    (
        "class Mine:\n parameters = (1,)\n def command(self): pass\n def skip(self): pass\n"
        " def statistics(self): pass", "is not a controller: it lacks a tuple of Parameter",
    ),
])
def test_classes_that_are_no_controllers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, message: str
) -> None:
    """Regardless of what the user's module does, the error has the class's path.

    The module is next to the current directory, where a console script finds it, too.
    """
    (tmp_path / "mine.py").write_text(code)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    with pytest.raises(ConfigurationError, match=f"controller = 'mine:Mine': {message}"):
        _ = find_controller("mine:Mine").kind


@pytest.mark.parametrize("name", ["lookahead", "anticipating_onoff"])
def test_how_far_a_controller_looks_ahead_follows_from_the_roof(name: str, tmp_path: Path) -> None:
    """Five days; on a roof with a field-capacity soil two; a file overrides both."""
    choice = find_controller(name)
    field_capacity = read_site(CONFIG / "site_catchment.yaml")
    assert choice.complete_parameters(PAPER_SITE, {})["horizon"] == 120.0
    assert choice.complete_parameters(field_capacity, {})["horizon"] == 48.0
    (tmp_path / "mine.yaml").write_text(f"{name}: {{ros__parameters: {{horizon: 24.0}}}}")
    assert choice.read_parameters(tmp_path / "mine.yaml")["horizon"] == 24.0
