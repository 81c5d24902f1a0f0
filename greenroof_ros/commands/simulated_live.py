"""Try a live site without any devices.

The command simulates the site's sensors and its drive, with a dry roof, and runs greenroof live on
them. The roof is watered within a minute. No forecast is needed, and no broker, except mosquitto
for the relay of a site with a valve; other options are passed to greenroof live, where those of the
devices have no effect. A longer tau is replaced by 1 s, which a live site requires. Ctrl-C ends the
site, and then its devices.

Examples:
  greenroof simulators live --watch
  greenroof simulators live --site my_site.yaml --controller onoff --watch
  greenroof simulators live --site config/site_valve.yaml --outlet drain --watch

Exit codes: those of greenroof live
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import yaml

from greenroof_ros.base.command_line import Parser, add_site, command, refuse
from greenroof_ros.base.processes import child_environment, scratch_directory
from greenroof_ros.commands.simulators import add_valve_fault
from greenroof_ros.live.devices.drive_file import find_drive_file
from greenroof_ros.site.file import format_site, read_site
from greenroof_ros.site.site import Site

_DRIVE, _RELAY = "danfoss_fc202", "tasmota"
# How full the cistern, and the roof relative to its target, are at the start: the roof is thirsty.
_CISTERN, _ROOF = 0.6, 0.7
# The broker accepts connections from this computer alone. If it is started by root, it stays root,
# since another user would not end with this process.
_BROKER = "listener {} 127.0.0.1\nallow_anonymous true\nuser root\n"
# The tick of a live site (s).
_TAU = 1.0


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser.of(
        "simulators live", __doc__, "[--site FILE] [--state DIR] [options of greenroof live]"
    )
    add_site(parser)
    parser.add_argument(
        "--state", type=Path, default=Path("simulated_live"), metavar="DIR",
        help="directory of the simulated site, not that of a real one (default: %(default)s)",
    )
    add_valve_fault(parser)
    return parser


@command
def main() -> None:
    """Start the simulated devices, and run the live site until it ends."""
    arguments, others = make_parser().parse_known_args()
    site = read_site(arguments.site)
    with ExitStack() as stack:
        directory = stack.enter_context(scratch_directory())
        drive_port, sensor_port, broker_port = _find_free_ports(3)
        sensors, site_file = directory / "sensors.yaml", arguments.site
        if site.tau > _TAU:
            print(f"tau of {site_file} is {site.tau:g} s; here it is {_TAU:g} s, as greenroof live "
                  f"requires (tau: {_TAU})", flush=True)
            site, site_file = replace(site, tau=_TAU), directory / site_file.name
            site_file.write_text(format_site(site), encoding="utf-8")
        sensors.write_text(_describe_sensors(site, sensor_port), encoding="utf-8")
        common = ["--site", str(site_file), "--sensors", str(sensors)]
        cistern = _CISTERN * site.cistern_volume(site.z_o)
        simulated = [f"--cistern={cistern}", f"--roof={_ROOF * site.x2_star}"]
        own = ["--state", str(arguments.state)]
        if site.irrigated:
            drive, at = directory / "drive.yaml", f"gateway://127.0.0.1:{drive_port}"
            content = yaml.safe_load(find_drive_file(_DRIVE).read_text(encoding="utf-8"))
            # Nothing is unverified: the simulated drive follows the file.
            drive.write_text(yaml.safe_dump({**content, "unverified": []}), encoding="utf-8")
            common += ["--drive", str(drive)]
            own += ["--drive-at", at]
            simulated += ["--at", at]
        if site.low_outlet_valve:
            common += ["--valve", _RELAY, "--valve-at", f"mqtt://127.0.0.1:{broker_port}/valve"]
        if arguments.valve_fault:
            simulated += ["--valve-fault", arguments.valve_fault]
        from greenroof_ros.live import live_site

        sys.argv = ["greenroof live", *others, *common, *own]
        live_site.LiveSite(live_site.make_parser().parse_args())  # a mistake is found before
        if site.low_outlet_valve:
            path, file = f"{os.environ['PATH']}:/usr/sbin", directory / "mosquitto.conf"
            broker = shutil.which("mosquitto", path=path) or ""
            refuse((not broker, "mosquitto", None, "is missing; a site with a valve needs it here"))
            file.write_text(_BROKER.format(broker_port), encoding="utf-8")
            ends = ["setpriv", "--pdeathsig", "TERM"]  # it ends with this process
            stack.enter_context(_run([*ends, broker, "-c", str(file)], subprocess.DEVNULL))
        devices = stack.enter_context(_run(
            [sys.executable, "-m", "greenroof_ros", "simulators", "site", *common, *simulated],
        ))
        assert devices.stdout is not None
        if devices.stdout.readline():  # they are ready
            # What they print later is not shown, but must not fill the pipe and stop them.
            threading.Thread(target=deque, args=(devices.stdout, 0), daemon=True).start()
            print(f"the simulated devices are process {devices.pid}", flush=True)
            live_site.main()  # it exits
        sys.exit(devices.wait())  # it has printed why it cannot start


@contextmanager
def _run(command: list[str], errors: int | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """Run a process until the end of a block, with its errors on a stream."""
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors,
        env=child_environment(),
        start_new_session=True,  # Ctrl-C is for the site, which still has to stop the pump
    )
    try:
        yield process
    finally:
        process.kill()  # at once: they have nothing to complete
        process.wait()


def _describe_sensors(site: Site, port: int) -> str:
    """Return a sensor file with all sensors that the site needs behind one Modbus port."""
    names = {"cistern": (0.0, 2.0 * site.z_o), "thermometer": (-40.0, 60.0)}
    if site.irrigated:
        names["roof"] = 0.0, 2.0 * site.z_soil
    if site.low_outlet_valve:
        names |= dict.fromkeys(("rain_gauge", "open_switch", "closed_switch"), (0.0, 1.0))
    return "".join(
        f'{name}: {{address: "tcp://127.0.0.1:{port}", device_id: {number}, register: 0, '
        f"kind: input, type: float32, word_order: high first, scale: 1.0, offset: 0.0, low: {low}, "
        f"high: {high}, median: 5, period: 1.0}}\n"
        for number, (name, (low, high)) in enumerate(names.items(), start=1)
    )


def _find_free_ports(count: int) -> list[int]:
    """Return TCP ports of the loopback address that are free now."""
    with ExitStack() as stack:
        servers = (socket.create_server(("127.0.0.1", 0)) for _ in range(count))
        return [stack.enter_context(server).getsockname()[1] for server in servers]
