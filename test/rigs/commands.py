"""The package's commands and nodes in forked processes that import nothing first.

A new Python process takes a second of processor time to import what commands and nodes need, and
the tests start two thousand of them. Here one process for each worker imports it once, and forks
for each command, with its own directory, environment and streams, as with ``python -m``. What
Python itself does when it starts is shown by test_interrupted.py, test_greenroof.py and others.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import importlib
import importlib.util
import json
import os
import pkgutil
import runpy
import socket
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from functools import cache
from pathlib import Path
from typing import Any

from places import words_of

_ROOMS = (
    "base", "interface", "controllers", "physics", "results", "simulation", "live.pumping",
    "live.devices", "live.simulators", "watch", "analysis", "analysis.report", "analysis.sizing",
    "analysis.district", "analysis.calibration", "ros", "bringup", "nodes", "live",
)
_OF_ROS = ("ros", "bringup", "nodes", "live")
_LIMIT_S = 900
_PR_SET_CHILD_SUBREAPER = 36


class Forked(subprocess.Popen[Any]):
    """A process that does what ``[sys.executable, "-m", module, ...]`` does.

    It is a child of this process. It is started as any other process if something must be done
    before it imports: a ``preexec_fn``, a library to load first, or a ``sitecustomize.py``.
    """

    def _execute_child(self, *given: Any) -> None:
        args, _, preexec_fn, _, _, cwd, env = given[:7]
        environment = dict(os.environ if env is None else env)
        if preexec_fn is not None or "LD_PRELOAD" in environment or any(
            Path(place, "sitecustomize.py").exists() for place in _python_path(environment)
        ):
            super()._execute_child(*given)  # type: ignore[misc]
            return
        pipes, session = given[10:16], given[21]
        streams = [
            number if pipe == -1 else pipe
            for number, pipe in enumerate((pipes[0], pipes[3], pipes[5]))
        ]
        request = args[2], args[3:], str(cwd or Path.cwd()), environment, session
        channel = _server()
        socket.send_fds(channel, [json.dumps(request).encode()], streams)
        self.pid = int(channel.recv(100))
        self._child_created = True
        self._close_pipe_fds(*pipes)  # type: ignore[attr-defined]


def _python_path(environment: dict[str, str]) -> list[str]:
    return list(filter(None, environment.get("PYTHONPATH", "").split(os.pathsep)))


def run_command(
    module: str, *arguments: str, cwd: Path, env: dict[str, str]
) -> subprocess.CompletedProcess[str]:
    """Run a command, by its module, until it ends; a node's module is e.g. nodes.plant."""
    with Forked(
        [sys.executable, "-m", *words_of(module), *arguments], cwd=cwd, env=env, text=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:
        try:
            out, err = process.communicate(timeout=_LIMIT_S)
        except BaseException:
            process.kill()
            raise
    return subprocess.CompletedProcess(arguments, process.returncode, out, err)


@cache
def _server() -> socket.socket:
    """Start the process that imports everything; it ends when this process closes the socket.

    What it forks becomes a child of this process, since the process between them ends.
    """
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    test, checkout = Path(__file__).resolve().parents[1:3]
    with theirs:
        subprocess.Popen(
            [sys.executable, __file__, str(theirs.fileno())], pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": f"{checkout}{os.pathsep}{test}"},
        )
    return ours


def _serve(channel: socket.socket) -> None:
    """Fork for each request, and answer with the number of the process."""
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
    while True:
        request, streams, _, _ = socket.recv_fds(channel, 1 << 20, 3)
        if not request:
            return
        reading, writing = os.pipe()
        between = os.fork()
        if between == 0:
            forked, has_forked = os.pipe()
            parent, child = os.getpid(), os.fork()
            if child:
                os.read(forked, 1)  # what a library does after a fork may look at the parent
                os.write(writing, str(child).encode())
                os._exit(0)
            os.write(has_forked, b".")
            os.close(forked)
            os.close(has_forked)
            for number in (channel.fileno(), reading, writing):
                os.close(number)
            while os.getppid() == parent:
                time.sleep(0.001)
            _become(*json.loads(request), streams)
        os.waitpid(between, 0)  # from now on it is the client's child
        channel.send(os.read(reading, 100))
        for number in (reading, writing, *streams):
            os.close(number)


def _become(
    module: str, arguments: list[str], cwd: str, env: dict[str, str], session: bool,
    streams: list[int],
) -> None:
    """Run a module in this process, which then ends."""
    if session:
        os.setsid()
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(env)
    time.tzset()
    tempfile.tempdir = None  # which TMPDIR decides
    sys.path[:0] = [cwd, *_python_path(env)]
    sys.argv = [module, *arguments]
    importlib.import_module("greenroof_ros.base.interrupts").begin_program("__main__")
    code = 0
    for name in (module, f"{module}.__main__"):  # imported above as a part of its package
        sys.modules.pop(name, None)
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        code = 1
    finally:
        threading._shutdown()  # type: ignore[attr-defined]
        atexit._run_exitfuncs()
        sys.stdout.flush()
        os._exit(code)


if __name__ == "__main__":
    rigs = Path(__file__).resolve().parent
    sys.path[:1] = map(str, (rigs.parents[1], rigs.parent, rigs))
    _serve(socket.socket(fileno=int(sys.argv[1])))
