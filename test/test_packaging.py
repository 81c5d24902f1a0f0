"""What pip and colcon make of the checkout: the real tools, in separate directories."""

import filecmp
import importlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path
from unittest import mock

import pytest
import yaml
from places import CHECKOUT

import greenroof_ros
from greenroof_ros.__main__ import COMMANDS

NODES = (
    "plant", "weather", "controller",
    "recorder", "live_weather", "live_controller", "live_recorder", "station",
    "pump", "pump_guard",
)
GREENROOF = "greenroof"
# What `ros2 run` finds in a workspace; pip installs only the first.
SCRIPTS = sorted((GREENROOF, *NODES))

# The rosdep keys of requirements that differ from the distribution's name.
ROSDEP_KEYS = {
    "pyyaml": ["python3-yaml"],
    "pymodbus": ["python3-pymodbus-pip", "python3-serial"],
    "rosbags": ["python3-rosbags-pip"],
}
# Extras for developers of this package, or for another ROS 2; the others are for users.
OTHER_EXTRAS = {"ros", "test", "docs", "bench"}


def run(*command, cwd, env, timeout=1800):
    """Run a command; if it fails, the error contains its output."""
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd, env=env, timeout=timeout, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )
    assert done.returncode == 0, f"{command} ended with {done.returncode}:\n{done.stdout}"
    return done.stdout


def bare_environment(home, *path):
    """Return an environment in which no ROS, workspace or virtual environment is active.

    Variables that tell programs how to reach the network are kept.
    """
    variables = {
        name: value for name, value in os.environ.items()
        if name.upper().startswith(("PIP_", "SSL_", "REQUESTS_", "GIT_"))
        or name.upper() in ("HTTP_PROXY", "HTTPS_PROXY", "NO_PROXY", "XDG_CACHE_HOME")
    }
    return variables | {
        "HOME": str(home),
        "LC_ALL": "C.UTF-8",
        "PATH": os.pathsep.join([*map(str, path), "/usr/local/bin", "/usr/bin", "/bin"]),
    }


def copy_of_checkout(directory):
    """Copy the project's files, without what builds and runs left behind."""
    generated = shutil.ignore_patterns(
        ".git", ".venv", "build", "install", "log", "dist", "runs", "*.egg-info", "__pycache__",
        ".*_cache", ".hypothesis",
    )
    shutil.copytree(CHECKOUT, directory, ignore=generated)
    return directory


def files_under(directory):
    """List the files under a directory, relative to it, without hidden files."""
    paths = [path.relative_to(directory) for path in directory.rglob("*") if path.is_file()]
    return sorted(path for path in paths if not any(part[0] == "." for part in path.parts))


def assert_installed(module, prefix):
    """Check that a prefix has the whole package and nothing else: modules, shared files, marker."""
    assert module.is_relative_to(prefix)
    # An editable install of the checkout would stand in for a missing module.
    compiled = (".pyc", ".pyi", ".nbi", ".nbc")
    ours = files_under(CHECKOUT / "greenroof_ros")
    files = [path for path in ours if path.suffix not in compiled]
    assert [path for path in files_under(module.parent) if path.suffix not in compiled] == files
    share = prefix / "share" / "greenroof_ros"
    for name in ("config", "examples", "msg_defs"):
        expected = [path for path in files_under(CHECKOUT / name) if path.suffix not in compiled]
        assert expected
        assert files_under(share / name) == expected
        _, different, unreadable = filecmp.cmpfiles(
            CHECKOUT / name, share / name, expected, shallow=False
        )
        assert not different
        assert not unreadable
    assert filecmp.cmp(CHECKOUT / "package.xml", share / "package.xml", shallow=False)
    packages = prefix / "share" / "ament_index" / "resource_index" / "packages"
    assert (packages / "greenroof_ros").is_file()


PRINT_SHARED_DIRECTORY = """
import greenroof_ros
from greenroof_ros.base.files import shared_directory
print(greenroof_ros.__file__)
print(shared_directory())
"""


@pytest.fixture(scope="module")
def package_index(tmp_path_factory):
    """Skip the test if pip cannot reach a package index."""
    directory = tmp_path_factory.mktemp("index")
    # Without pip's cache, which would not show whether the index is reachable.
    probe = subprocess.run(
        [sys.executable, "-m", "pip", "--no-cache-dir", "--retries", "1", "--timeout", "20",
         "download", "--no-deps", "--dest", directory, "iniconfig"],
        text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=directory, timeout=1800,
    )
    if probe.returncode:
        pytest.skip(f"pip reaches no package index: {probe.stdout.strip().splitlines()[-1]}")


# -------------------------------------------------------------------------------------- pip


@pytest.fixture(scope="module")
def released(package_index, tmp_path_factory):
    """Return the directory of sdist and wheel; the wheel is built from the sdist."""
    directory = tmp_path_factory.mktemp("release")
    checkout = copy_of_checkout(directory / "checkout")
    environment = bare_environment(Path(os.environ.get("HOME", directory)))  # holds pip's cache
    run(sys.executable, "-m", "build", "--outdir", directory / "dist", ".",
        cwd=checkout, env=environment)
    shutil.rmtree(checkout)  # nothing may depend on it any more
    return directory / "dist"


def test_a_package_index_would_take_the_release(released):
    """Sdist and wheel fit any machine, show their README, and the wheel has no stray files.

    The sdist has what a user copies, and no tests.
    """
    files = sorted(released.iterdir())
    name = f"greenroof_ros-{greenroof_ros.__version__}"
    assert [file.name for file in files] == [f"{name}-py3-none-any.whl", f"{name}.tar.gz"]
    environment = dict(os.environ)
    run(sys.executable, "-m", "twine", "check", "--strict", *files, cwd=released, env=environment)
    run(sys.executable, "-m", "check_wheel_contents", files[0], cwd=released, env=environment)
    with tarfile.open(files[1]) as source:
        packed = {Path(*Path(name).parts[1:]) for name in source.getnames()}
    copied = [path for name in ("config", "examples", "msg_defs")
              for path in (CHECKOUT / name).rglob("*") if "__pycache__" not in path.parts]
    assert {path.relative_to(CHECKOUT) for path in copied} | {Path("CHANGELOG.rst")} <= packed
    assert Path("test") not in packed


# Two runs of half an hour.
SMALL_GRID = """
site: site.yaml
weather:
  - file: weather/toronto_2021-07.csv
    start: 2021-07-07T02:00
    hours: 0.5
    evapotranspiration: published
initial: low-low
controllers: {mpc: {}, onoff: {}}
"""


def test_pip_install_lays_everything_but_ros(released, tmp_path):
    """In any directory: a simulation, and with the extra a user's grid and the page of its results.

    No node gets a generic name on the PATH, such as weather.
    """
    venv = tmp_path / "venv"
    commands, environment = venv / "bin", bare_environment(tmp_path, venv / "bin")
    # Without pip: installing it would take as long as everything else.
    run(sys.executable, "-m", "venv", "--without-pip", venv, cwd=tmp_path, env=environment)

    def install(extras):
        (wheel,) = released.glob("*.whl")
        run(sys.executable, "-m", "pip", "--python", commands / "python", "install",
            "--no-compile", f"{wheel}{extras}", cwd=tmp_path,
            env=bare_environment(Path(os.environ.get("HOME", tmp_path))))

    def greenroof(*words):
        return run(commands / GREENROOF, *words, cwd=tmp_path, env=environment)

    install("")
    (packages,) = venv.glob("lib/python*/site-packages")
    names = [path.name for path in packages.iterdir()]
    assert not [name for name in names if name.startswith(("ros", "rcl", "rmw", "std_msgs"))]
    printed = run(
        commands / "python", "-c", PRINT_SHARED_DIRECTORY, cwd=tmp_path, env=environment
    )
    module, shared = map(Path, printed.split())
    assert_installed(module, venv.resolve())
    assert shared == venv.resolve() / "share" / "greenroof_ros"
    assert [name for name in SCRIPTS if os.access(commands / name, os.X_OK)] == [GREENROOF]
    assert greenroof("simulate", "--hours", "0.01").strip()
    install("[study]")  # what both have in common is installed once
    (tmp_path / "small.yaml").write_text(SMALL_GRID)
    greenroof("study", "small.yaml", "--output", "study")
    greenroof("report", "study")
    assert len((tmp_path / "study" / "results.csv").read_text().splitlines()) == 1 + 2
    assert "</html>" in (tmp_path / "study" / "report" / "report.html").read_text()
    assert list((tmp_path / "study" / "report" / "figures").glob("*.png"))


def test_an_editable_install_works_in_the_folder_with_the_clone(tmp_path):
    """The clone's folder has the package's name; Python must not import it as a namespace."""
    (tmp_path / "greenroof_ros").symlink_to(CHECKOUT)
    module = run(
        sys.executable, "-c", "import greenroof_ros; print(greenroof_ros.__file__)", cwd=tmp_path,
        env=bare_environment(tmp_path),
    )
    assert Path(module.strip()).parts[-2:] == ("greenroof_ros", "__init__.py")


# -------------------------------------------------------------------------------------- colcon


def test_colcon_build_lays_everything_and_its_executables(tmp_path):
    """Built from a copy of the checkout with nothing sourced; then only the workspace is."""
    next_to_python = Path(sys.executable).parent
    colcon = shutil.which("colcon", path=str(next_to_python)) or shutil.which("colcon")
    if colcon is None:
        pytest.skip("colcon is not installed; it is in the extra [test]")
    environment = bare_environment(tmp_path, next_to_python)
    copy_of_checkout(tmp_path / "src" / "greenroof_ros")
    built = run(
        colcon, "--log-base", tmp_path / "log", "build", "--event-handlers", "console_direct+",
        cwd=tmp_path, env=environment,
    )
    # colcon also ends with 0 if it found nothing to build.
    assert (tmp_path / "install" / "setup.bash").is_file(), built
    shutil.rmtree(tmp_path / "src")
    shutil.rmtree(tmp_path / "build")
    path = tmp_path / "install" / "greenroof_ros"
    executables = path / "lib" / "greenroof_ros"  # where ros2 run looks
    script = (
        "source install/setup.bash && echo $AMENT_PREFIX_PATH && "
        f"{sys.executable} -c '{PRINT_SHARED_DIRECTORY}' && "
        f"{executables}/greenroof simulate --hours 0.01"
    )
    printed = run("bash", "--noprofile", "--norc", "-c", script, cwd=tmp_path, env=environment)
    prefix, module, shared, simulated = printed.split(maxsplit=3)
    assert (Path(prefix), Path(shared)) == (path, path.resolve() / "share" / "greenroof_ros")
    assert_installed(Path(module), path.resolve())
    names = [file.name for file in executables.iterdir() if os.access(file, os.X_OK)]
    assert sorted(names) == SCRIPTS
    assert simulated.strip()


# -------------------------------------------------------------------------------- the files agree


def options_of_setup(*commands):
    """Return what setup.py passes to setuptools when it is called with these commands."""
    code = (
        "import json, setuptools\n"
        "from distutils.core import run_setup\n"
        f"d = run_setup('setup.py', {list(commands)}, stop_after='init')\n"
        "print(json.dumps(dict(name=d.get_name(), version=d.get_version(),"
        " license=d.metadata.license, entry_points=d.entry_points,"
        " install_requires=d.install_requires, extras_require=d.extras_require)))\n"
    )
    printed = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code],
        cwd=CHECKOUT, text=True, stdout=subprocess.PIPE, check=True, timeout=300,
    ).stdout
    return json.loads(printed.splitlines()[-1])


@pytest.fixture(scope="module")
def setup_options():
    """Return what setup.py passes to setuptools for pip."""
    return options_of_setup("bdist_wheel")


@pytest.fixture(scope="module")
def manifest():
    """Return package.xml as ROS tools read it."""
    catkin_pkg = pytest.importorskip("catkin_pkg.package", reason="comes with colcon-ros")
    warnings: list[str] = []
    package = catkin_pkg.parse_package(str(CHECKOUT / "package.xml"), warnings=warnings)
    assert warnings == []
    return package


def distribution(requirement):
    """Return the normalised name at the start of a requirement."""
    return re.match(r"[A-Za-z0-9._-]+", requirement)[0].lower().replace("_", "-")


def test_the_files_agree_on_name_version_and_licence(manifest, setup_options):
    assert manifest.get_build_type() == "ament_python"
    assert manifest.name == setup_options["name"] == "greenroof_ros"
    assert [str(text) for text in manifest.licenses] == [setup_options["license"]]
    changelog = (CHECKOUT / "CHANGELOG.rst").read_text(encoding="utf-8")
    # REP 132: a version, then its date in parentheses, underlined; the newest comes first.
    heading = r"^(\S+) \((?:forthcoming|\d{4}-\d\d-\d\d)\)\n-{5,}$"
    newest = re.search(heading, changelog, re.MULTILINE)
    citation = yaml.safe_load((CHECKOUT / "CITATION.cff").read_text(encoding="utf-8"))
    versions = {manifest.version, setup_options["version"], newest[1], citation["version"]}
    assert versions == {greenroof_ros.__version__}


def test_package_xml_names_every_requirement(manifest, setup_options):
    """By rosdep keys, and nothing else; a comment lists the requirements without a key."""
    extras = setup_options["extras_require"]
    assert extras.keys() > OTHER_EXTRAS
    named = [setup_options["install_requires"]]
    named += [texts for extra, texts in extras.items() if extra not in OTHER_EXTRAS]
    requirements = {distribution(text) for texts in named for text in texts}
    (comment,) = re.findall(
        r"<!--\s*rosdep has no key.*?-->", (CHECKOUT / "package.xml").read_text(), re.DOTALL
    )
    without = {name for name in requirements if re.search(rf"\b{name}\b", comment)}
    assert without
    ros = {
        distribution(text).removeprefix("ros-jazzy-").replace("-", "_") for text in extras["ros"]
    }
    keys = {
        key for name in requirements - without
        for key in ROSDEP_KEYS.get(name, [f"python3-{name}"])
    }
    assert {depend.name for depend in manifest.exec_depends} == keys | ros
    topics = yaml.safe_load((CHECKOUT / "msg_defs" / "topics.yaml").read_text(encoding="utf-8"))
    assert {topic["type"].split("/")[0] for topic in topics["topics"].values()} <= ros


def test_executables_can_be_called():
    """The target of each executable of a workspace can be imported and called."""
    entries = options_of_setup("install")["entry_points"]["console_scripts"]
    targets = dict(entry.replace(" ", "").split("=") for entry in entries)
    assert sorted(targets) == SCRIPTS
    if importlib.util.find_spec("rclpy") is None:  # the extra [ros], or a sourced ROS 2
        targets = {name: target for name, target in targets.items() if name not in NODES}
    for target in targets.values():
        module, function = target.split(":")
        assert callable(getattr(importlib.import_module(module), function)), target


UNITS = sorted((CHECKOUT / "examples").glob("*.service"))


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_the_services_are_ones_that_systemd_takes(unit: Path) -> None:
    """systemd's own check accepts the units, apart from paths that depend on the site."""
    try:
        done = subprocess.run(
            ["systemd-analyze", "verify", "--man=no", str(unit)],
            capture_output=True, text=True, check=False,
        )
    except FileNotFoundError:
        pytest.skip("there is no systemd here")
    lines = [line for line in done.stderr.splitlines() if unit.name in line]
    assert not [line for line in lines if "is not executable" not in line], done.stderr


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_the_services_use_options_that_exist(unit: Path) -> None:
    """All units run in one domain, as one user; releasing the pump takes a person's decision."""
    lines = unit.read_text().replace("\\\n", " ").splitlines()
    assert {"User=greenroof", "Environment=ROS_DOMAIN_ID=42"} <= {*lines}
    commands = [line for line in lines if line.startswith(("ExecStart=", "ExecStopPost="))]
    drives = set()
    for program, name, *options in (line.partition("=")[2].split() for line in commands):
        assert program == "/opt/greenroof/bin/greenroof"
        with mock.patch.object(sys, "argv", ["greenroof", *options]):
            given = COMMANDS[name].load().make_parser().parse_args(options)
        drives.add((getattr(given, "drive", ""), getattr(given, "drive_at", "")))
        assert "--allow-release" not in options
    assert commands and len(drives) == 1  # the one that runs is the one that is stopped
