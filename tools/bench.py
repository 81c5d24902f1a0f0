"""Measure the speed of the graph and the controller, as ratios within one run: ``make bench``.

Times on a shared machine mean little, but ratios of times that are measured together, round by
round, are comparable.
"""

from __future__ import annotations

import argparse
import json
import os
import pty
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from typing import Any, NamedTuple

import paths  # noqa: F401
from graphs import environment, reserved_domain
from markdown_tables import head, row
from places import CONFIG

ROUNDS = 5
HOURS = 2
ECHOES = 7200


def echo(role: str) -> None:
    """Run one of the two processes that send a Float64 back and forth, as a yardstick."""
    import rclpy
    from rclpy.experimental import EventsExecutor
    from rclpy.node import Node
    from std_msgs.msg import Float64

    from greenroof_ros.interface.topics import read_topics
    from greenroof_ros.ros.messages import qos_profile

    rclpy.init(args=[])
    node = Node(role)
    executor = EventsExecutor()
    executor.add_node(node)
    profile = qos_profile(read_topics()["/roof/level"].qos)
    outward, inward = ("ping", "pong") if role == "caller" else ("pong", "ping")
    publisher = node.create_publisher(Float64, outward, profile)
    received = 0

    def answer(message: Float64) -> None:
        nonlocal received
        received += 1
        publisher.publish(message)

    node.create_subscription(Float64, inward, answer, profile)
    if role == "answerer":
        while True:
            executor.spin_once(timeout_sec=0.5)
    until = time.monotonic() + 3
    while time.monotonic() < until:
        executor.spin_once(timeout_sec=0.1)
    publisher.publish(Float64())
    while received < 500:
        executor.spin_once(timeout_sec=0.5)
    first, began = received, time.perf_counter()
    while received < first + ECHOES:
        executor.spin_once(timeout_sec=0.5)
    print((time.perf_counter() - began) / ECHOES)
    sys.stdout.flush()
    os._exit(0)


def measure_echo(domain: int) -> float:
    """Return the time of a round trip between two processes (s)."""
    command = [sys.executable, __file__]
    answerer = subprocess.Popen(
        [*command, "answerer"], env=environment(domain), stderr=subprocess.DEVNULL
    )
    try:
        done = subprocess.run(
            [*command, "caller"],
            env=environment(domain), check=True, capture_output=True, text=True,
        )
    finally:
        answerer.kill()
        answerer.wait()
    return float(done.stdout)


class Graph(NamedTuple):
    """The times of a run of the graph that is started as a user would start it."""

    tick: float
    """wall time of a tick (s)"""
    around: float
    """wall time from the start of the command to its end, without the ticks (s)"""
    echo: float
    """time of a round trip between two processes (s), the mean of just before and just after"""

    @property
    def trips(self) -> float:
        """Duration of a tick, in round trips (1)."""
        return self.tick / self.echo


def measure_graph(domain: int, *arguments: str) -> Graph:
    """Run the graph on a terminal, so it draws its progress bar, and return its times."""
    before = measure_echo(domain)
    environ = {**environment(domain), "TERM": "xterm"}
    with tempfile.TemporaryDirectory() as directory:
        leader, follower = pty.openpty()
        drain = threading.Thread(target=_drain, args=(leader,), daemon=True)
        drain.start()
        began = time.perf_counter()
        done = subprocess.run(
            [
                sys.executable, "-m", "greenroof_ros", "run", "--json", "--hours", str(HOURS),
                "--output", f"{directory}/run", *arguments,
            ],
            env=environ, cwd=directory, check=True,
            stdout=subprocess.PIPE, stderr=follower, text=True,
        )
        whole = time.perf_counter() - began
        os.close(follower)
    summary = json.loads(done.stdout)
    ticks = float(summary["wall_s"])
    echo = (before + measure_echo(domain)) / 2
    return Graph(ticks / int(summary["steps"]), whole - ticks, echo)


def _drain(leader: int) -> None:
    try:
        while os.read(leader, 1 << 16):
            pass
    except OSError:
        return


def measure_simulated(*arguments: str) -> tuple[float, dict[str, float]]:
    """Return the time of a tick of ``simulate`` with metrics (s), and its decision times (s)."""
    from greenroof_ros.base.command_line import Parser
    from greenroof_ros.simulation.loop import Simulation
    from greenroof_ros.simulation.options import add_run_arguments, build_run

    parser = Parser()
    add_run_arguments(parser, arguments)
    run = build_run(parser.parse_args(arguments))
    controller = run.make_controller()
    began = time.perf_counter()
    for _ in Simulation(run, controller).ticks():
        pass
    return (time.perf_counter() - began) / run.steps, controller.statistics() or {}


def measure_do_mpc(steps: int = 30) -> float:
    """Return the time of a do-mpc step on the same problem (s).

    The problem has a smooth plant, a horizon of 10 steps and the same cost.
    """
    import casadi
    import do_mpc
    import numpy as np

    from greenroof_ros.physics.start import initial_states
    from greenroof_ros.site.file import read_site

    site = read_site(CONFIG / "site.yaml")
    model: Any = do_mpc.model.Model("discrete")
    x1, x2 = model.set_variable("_x", "x1"), model.set_variable("_x", "x2")
    u = model.set_variable("_u", "u")
    rain = model.set_variable("_tvp", "rain")
    evapotranspiration = model.set_variable("_tvp", "evapotranspiration")
    e = site.epsilon

    def psi(y: Any) -> Any:
        positive = casadi.fmax(y, 1e-12)
        low = positive**1.5 / (3 * e) + 2 / 3 * e**0.5
        return casadi.if_else(
            y > e, casadi.sqrt(positive), casadi.if_else(y > 0, low, 2 / 3 * e**0.5)
        )

    def sigma(y: Any) -> Any:
        return 1 / (1 + casadi.exp(-y / e))

    q_out = site.c_out * psi(x1 / site.a1 - site.z_o)
    q_pump = (
        u * site.b * psi(x1 / site.a1 + site.c_hat - site.d)
        * sigma(x1 - site.a1 * site.suction_level) * sigma(site.x2_star - x2)
    )
    q_drain = (
        site.K * site.a2 * (x2 / site.a2 + site.z_soil) / site.z_soil * sigma(x2 - site.z_cap)
    )
    model.set_rhs("x1", x1 + site.tau * (rain * site.a_in - q_out - q_pump))
    model.set_rhs("x2", x2 + site.tau * (rain * site.a2 + q_pump - evapotranspiration - q_drain))
    model.setup()
    controller: Any = do_mpc.controller.MPC(model)
    controller.settings.n_horizon = site.M
    controller.settings.t_step = site.tau
    controller.settings.store_full_solution = False
    controller.settings.supress_ipopt_output()
    cost = (x2 / site.a2 - site.z_veg) ** 2
    controller.set_objective(mterm=cost, lterm=cost + 0.001 * u**2)
    controller.bounds["lower", "_u", "u"] = 0
    template = controller.get_tvp_template()
    controller.set_tvp_fun(lambda now: template)
    controller.setup()
    state = np.array(initial_states(site)["low-low"]).reshape(-1, 1)
    controller.x0 = state
    controller.set_initial_guess()
    controller.make_step(state)
    began = time.perf_counter()
    for _ in range(steps):
        controller.make_step(state)
    return (time.perf_counter() - began) / steps


MEASURED = {
    "tick": "tick of `greenroof run` / echo round trip of two processes",
    "bare": "the same without the recorder",
    "around": "start and end of `greenroof run` without its ticks (s)",
    "mean": "decision of `lookahead` on an ensemble / decision of `mpc`, mean of all ticks",
    "p99": "the same, 99th percentile",
    "plan": "longest decision of `lookahead`, with a plan / mean decision of `mpc`",
    "do_mpc": "do-mpc step / MPC step of `simulate`",
}


def main() -> None:
    """Measure in rounds and print the ratios."""
    rows: dict[str, list[float]] = {key: [] for key in MEASURED}
    with reserved_domain() as domain:
        for number in range(ROUNDS):
            load = os.getloadavg()[0]  # over the last minute
            recorded = measure_graph(domain)
            bare = measure_graph(domain, "--no-record")
            (step, mpc), peer = measure_simulated(), measure_do_mpc()
            _, ahead = measure_simulated("--controller", "lookahead", "--forecast", "ensemble")
            rows["tick"].append(recorded.trips)
            rows["bare"].append(bare.trips)
            rows["around"].append(recorded.around)
            rows["mean"].append(ahead["mean_s"] / mpc["mean_s"])
            rows["p99"].append(ahead["p99_s"] / mpc["p99_s"])
            rows["plan"].append(ahead["max_s"] / mpc["mean_s"])
            rows["do_mpc"].append(peer / step)
            print(
                f"round {number + 1} of {ROUNDS}, load before it {load:.1f}: "
                f"echo {recorded.echo * 1e6:.0f} us, tick {recorded.tick * 1e6:.0f} us, "
                f"MPC step {step * 1e6:.0f} us, do-mpc {peer * 1e6:.0f} us",
                file=sys.stderr, flush=True,
            )
    print(head(["measured together", "median", "rounds"]))
    for key, name in MEASURED.items():
        values = ", ".join(f"{value:.2f}" for value in rows[key])
        print(row([name, f"{statistics.median(rows[key]):.2f}", values]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "role", nargs="?", choices=("caller", "answerer"), help="internal: one end of the echo"
    )
    role = parser.parse_args().role
    if role:
        echo(role)
    else:
        main()
