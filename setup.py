"""Build script of greenroof_ros, for plain pip and for colcon (ament_python) alike."""

import re
import sys
from pathlib import Path

from setuptools import find_packages, setup

NAME = "greenroof_ros"
SHARE = Path("share") / NAME

# Compiles the plant where there is much to do: seasons, studies, sizes, districts and environments.
# It takes 200 MB, and nodes do not need it. 0.68 is the oldest that was tried.
NUMBA = "numba>=0.68,<1"
# What ``ros2 run greenroof_ros NAME`` starts in a workspace, besides ``greenroof``.
NODES = {
    **{name: f"nodes.{name}" for name in ("plant", "weather", "controller", "recorder")},
    **{f"live_{name}": f"live.{name}" for name in ("weather", "controller", "recorder")},
    **{name: f"live.{name}" for name in ("station", "pump")},
    "pump_guard": "live.external_pump",
}
# Colcon calls one of these, and setup.cfg sets where executables go. Pip calls neither, and would
# put names such as `plant` and `weather` on everybody's PATH.
IN_WORKSPACE = not {"install", "develop"}.isdisjoint(sys.argv)
EXECUTABLES = [f"{name} = {NAME}.{module}:main" for name, module in NODES.items()]


def version() -> str:
    """Read the version from the package without importing it, which would need its requirements."""
    text = (Path(NAME) / "base" / "versions.py").read_text(encoding="utf-8")
    match = re.search(r'^__version__ = "([^"]+)"$', text, re.MULTILINE)
    if match is None:
        raise RuntimeError(f"{NAME}/base/versions.py has no line of the form __version__ = \"...\"")
    return match[1]


def shared_files(directory: str) -> list[tuple[str, list[str]]]:
    """List the files under a directory of the checkout, to go to the same place under share/."""
    by_folder: dict[Path, list[str]] = {}
    for path in sorted(Path(directory).rglob("*")):
        if path.is_file() and not any(part.startswith((".", "__")) for part in path.parts):
            by_folder.setdefault(path.parent, []).append(path.as_posix())
    return [((SHARE / folder).as_posix(), files) for folder, files in by_folder.items()]


setup(
    name=NAME,
    version=version(),
    description="Water a green roof from its rainwater cistern; keep the storm out of the sewer",
    long_description=Path("README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    maintainer="greenroof_ros maintainers",
    maintainer_email="maintainers@users.noreply.github.com",
    license="Apache-2.0",
    license_files=["LICENSE"],
    python_requires=">=3.11",
    classifiers=[
        "Development Status :: 4 - Beta",
        "Intended Audience :: Science/Research",
        "License :: OSI Approved :: Apache Software License",
        "Operating System :: POSIX :: Linux",  # others: see doc/howto/install.md, What was tested
        "Programming Language :: Python :: 3",
        "Programming Language :: Python :: 3 :: Only",
        "Topic :: Scientific/Engineering :: Hydrology",
    ],
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    # With it an editable install is a path of a .pth file. Otherwise the clone's folder, which has
    # the package's name, would be imported by a Python that starts in the folder above.
    package_dir={"": "."},
    package_data={NAME: ["py.typed"], f"{NAME}.commands": ["new_site.yaml"],
                  f"{NAME}.analysis": ["page.html"], f"{NAME}.watch": ["page/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (SHARE.as_posix(), ["package.xml"]),
        *shared_files("config"),
        *shared_files("examples"),
        *shared_files("msg_defs"),
    ],
    # What the simulation needs. The oldest version is the oldest that was tried or, where it is
    # stated so, that has what is used; the upper limit is the next release that may change
    # interfaces.
    install_requires=[
        "numpy>=1.22,<3",  # the model's Jacobians and the controller's matrices
        "scipy>=1.8,<2",  # OSQP's sparse matrices; HiGHS, for the bound
        "osqp>=1.0.3,<2",  # solves the controller's program; 1.0.3 has SolverStatus
        "mcap>=1.5,<2",  # reads bags, and defines most of their records; brings zstandard
        "eto>=2.2,<3",  # FAO-56 Penman-Monteith; 2.2 has hours in any time zone and clouded nights
        "PyYAML>=6.0,<7",  # reads config/ and msg_defs/, writes a bag's metadata.yaml
        "filelock>=3.9,<5",  # locks of studies, sites and directories, also on Windows
        "platformdirs>=2.6,<5",  # where a user's state belongs; 2.6 is Debian 12's
        "rich>=13,<16",  # progress bar and tables on the terminal
        "urllib3>=2.6,<3",  # requests to weather services; 2.6 limits their Retry-After
    ],
    extras_require={
        # ROS 2 Jazzy as plain wheels, for a machine without ROS. Leave this extra away where a
        # ROS 2 is installed already (apt, conda): pip would lay a second one over it.
        "ros": [
            "ros-jazzy-rclpy[fastrtps]>=7.1,<8",  # the client library, and a DDS to go with it
            "ros-jazzy-std-msgs>=5.3,<6",  # Float64, Float64MultiArray: nearly every topic
            "ros-jazzy-rosgraph-msgs>=2.0,<3",  # Clock
            "ros-jazzy-diagnostic-msgs>=5.3,<6",  # /diagnostics
            "ros-jazzy-rcl-interfaces>=2.0,<3",  # descriptors and results of node parameters
            "ros-jazzy-std-srvs>=5.3,<6",  # the pump node's services
        ],
        # The pump node's drives and sensors on Modbus, and their simulators.
        "pump": [
            # TCP and RTU; its minor releases change the interface, which has `device_id` since 3.10
            "pymodbus[serial]>=3.16,<3.17",
        ],
        # Sensors and relays on MQTT, and the bridge to Home Assistant.
        "mqtt": ["paho-mqtt>=2.1,<3"],  # Eclipse's own client; 2 names the reasons of failures
        # Studies of many runs, and reports with figures; neither needs a ROS.
        "study": [
            NUMBA,
            "polars>=1.33,<3",  # trajectories as parquet; from 1.33 on it takes metadata
            "rosbags>=0.11,<1",  # reads any bag, of any storage
            "altair>=6,<7",  # figures: one description for page, PNG and SVG
            "vl-convert-python>=1.8,<2",  # draws them without a browser; brings the page's scripts
            "Jinja2>=3,<4",  # the page
        ],
        # The page that shows what the roof does.
        "watch": [
            # Server, pushing and files in one library, and no framework on top of it; ROS 2
            # Jazzy's Ubuntu has 3.9
            "aiohttp>=3.9.1,<4",
        ],
        # The graph for Foxglove and Lichtblick: their protocol, from its makers.
        "foxglove": ["foxglove-sdk>=0.30,<0.31"],  # its minor releases change the interface
        # The environments GreenRoof-v1 and GreenRoofVector-v1, for reinforcement learning.
        "gym": ["gymnasium>=1.1,<2", NUMBA],
        "test": [
            # With 9.2, pytest-xdist 3.8 keeps no group together: fixtures are made once a worker.
            "pytest>=8,<9.2",
            "pytest-xdist>=3.8,<4",  # the tests on all cores; 3.8 is the oldest that was tried
            "pytest-timeout>=2.3,<3",  # a test that hangs fails, and the others go on
            "hypothesis>=6.100",  # properties of the plant and the controllers
            # EPA's SWMM 5.2: hydrographs of the same cistern; 0.17 is the oldest that was tried.
            "swmm-toolkit>=0.17,<1",
            "distributed>=2024.1",  # a study on the workers of a Dask cluster
            "gymnasium>=1.1,<2",  # whether its checks pass the environment
            "pandas>=2",  # weather in its data frames, and trajectories as such
            "pyarrow>=15",  # what polars needs for that
            "nbclient>=0.10",  # runs the notebook in examples/
            "nbformat>=5.9",
            "ipykernel>=6",
            "playwright>=1.40",  # reads the report's page in the system's Chromium
            # A new minor release of a linter brings new rules; they are adopted on purpose.
            "ruff~=0.17.0",
            "mypy~=2.4.0",
            "types-PyYAML>=6.0",
            "codespell>=2.4,<3",  # spelling
            "import-linter>=2.16,<3",  # which room may import from which: pyproject.toml
            "build>=1.2",  # sdist and wheel, as they would be released
            "twine>=6",  # whether a package index would take them
            "check-wheel-contents>=0.6,<1",  # whether the wheel has what it should, and no more
            # Builds the package in a workspace of its own, as a ROS 2 user does.
            "colcon-ros>=0.5",  # the build type ament_python; brings colcon-core
            "colcon-bash>=0.5",  # install/setup.bash
            "setuptools>=64,<80",  # colcon-core's own limit; a venv of Python 3.12 on has none
        ],
        # The documentation: make docs.
        "docs": [
            "sphinx>=8.1,<10",  # pages, and their API part from the docstrings
            "myst-parser>=4,<6",  # pages are Markdown
            "furo>=2024.8.6",  # theme: light and dark, wide and narrow
        ],
        # Another implementation of the same controller, to compare the solve times with.
        "bench": ["do-mpc>=5.1,<6"],
    },
    entry_points={
        "console_scripts": [
            f"greenroof = {NAME}.__main__:main", *(EXECUTABLES if IN_WORKSPACE else []),
        ],
    },
    zip_safe=False,
)
