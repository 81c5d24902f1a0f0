"""Commands in forked processes that import nothing first; most of them are expected to be refused.

A new Python process takes a second to import what the commands need, and three hundred tests
of wrong options and files need nothing else from it. Here one process imports it once, and forks
for each command: with its own directory, environment, output and exit code, as with
``python -m``.
"""

from __future__ import annotations

import gc
import importlib
import importlib.util
import json
import os
import pkgutil
import runpy
import signal
import subprocess
import sys
import tempfile
import traceback
from functools import cache
from pathlib import Path

from places import words_of

# Without the nodes: each must be the main module of its process.
_ROOMS = (
    "common", "controllers", "experiment", "live.pumping", "live.devices", "recording",
    "live.simulators", "watch", "analysis.report", "analysis.study", "analysis.calibration",
    "analysis.verification", "graph", "bringup",
)
_OF_ROS = ("graph", "bringup")
_LIMIT_S = 900


def run_command(
    module: str, *arguments: str, cwd: Path, env: dict[str, str]
) -> subprocess.CompletedProcess[str]:
    """Run a command, by its module, until it ends; a node's module is e.g. nodes.plant."""
    server = _server()
    assert server.stdin is not None and server.stdout is not None
    with tempfile.TemporaryDirectory() as scratch:
        out, err = (Path(scratch) / name for name in ("out", "err"))
        name, *words = words_of(module)
        request = (name, (*words, *arguments), str(cwd), env, str(out), str(err))
        server.stdin.write(json.dumps(request) + "\n")
        server.stdin.flush()
        code = int(server.stdout.readline())
        return subprocess.CompletedProcess(arguments, code, out.read_text(), err.read_text())


@cache
def _server() -> subprocess.Popen[str]:
    """Start the process that imports everything; it ends when this process closes its stdin."""
    return subprocess.Popen(
        [sys.executable, __file__], text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )


def _serve() -> None:
    """Fork for each request, and answer with the exit code."""
    sys.path[0] = str(Path(__file__).resolve().parent.parent)
    for room in _ROOMS:
        if room in _OF_ROS and importlib.util.find_spec("rclpy") is None:
            continue
        package = importlib.import_module(f"greenroof_ros.{room}")
        for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
            if not module.name.endswith(".__main__"):
                importlib.import_module(module.name)
    for solver in ("osqp", "scipy.optimize"):  # they import modules when they first solve something
        importlib.import_module(solver)
    gc.freeze()  # keeps children from copying pages in garbage collection
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            _become(*json.loads(line))
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


def _become(
    module: str, arguments: list[str], cwd: str, env: dict[str, str], out: str, err: str
) -> None:
    """Run as the command in this process; an alarm ends it after the limit."""
    signal.alarm(_LIMIT_S)
    null = os.open(os.devnull, os.O_RDONLY)
    outputs = [os.open(file, os.O_WRONLY | os.O_CREAT) for file in (out, err)]
    for number, stream in enumerate((null, *outputs)):
        os.dup2(stream, number)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(env)
    sys.argv = [module, *arguments]
    code = 0
    sys.modules.pop(module, None)  # imported above as a part of its package
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        code = 1
    finally:
        sys.stdout.flush()
        os._exit(code)


if __name__ == "__main__":
    _serve()
