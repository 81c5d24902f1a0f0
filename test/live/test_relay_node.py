"""The pump node with a simulated relay on MQTT and a real broker.

The contact's state is read at the simulator's workbench, not from the node. What happens if the
broker dies or the relay drops out is in the sample of the campaign, test_faults.py.
"""

from __future__ import annotations

from brokers import mosquitto, needs_mosquitto
from graphs import Process
from pump_node_rig import PumpRig
from ros_rig import Observer


@needs_mosquitto
def test_check_pump_finds_it_right(observer: Observer) -> None:
    """At command 1, at which a relay stays on; the check acts as all peers, so no one publishes."""
    rig = PumpRig(observer)
    with mosquitto(observer.cwd) as broker:
        rig.simulate(
            "--at", f"{broker.address}/roof", make="tasmota",
            pace=("--boot", "0.1", "--timeout", "3"),
        )
        rig.remove_publishers()
        rig.start(drive="tasmota")
        check = Process(
            rig.domain, "check_pump", "--node", "pump", "--live", "--period", "0.1",
            "--command", "1", "--site", str(rig.cwd / "site.yaml"), cwd=rig.cwd,
        )
        assert check.wait(300) == 0, check.stdout() + check.stderr()
        assert rig.drive.speed() == 0.0
