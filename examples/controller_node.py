"""A controller as a separate node, which needs only rclpy.

Start the node before every ``greenroof run --controller external``. It follows the same rule as the
class in ``examples/proportional.py``. At a site with a valve on the low outlet of the cistern,
start the node with ``--ros-args -p valve:=true`` to command the valve as well.
"""

import math
from contextlib import suppress

import rclpy
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Float64, Float64MultiArray

TARGET, SUCTION = 0.0457, 0.75  # target of the roof, suction level of the pumps (m)
GAIN = 20.0  # command for each metre below the target (1/m)
FULL = 2.0  # cistern level above which the valve is open (m)
INPUTS = {
    "cistern/level": Float64, "roof/level": Float64, "weather/frost": Float64,
    "forecast/precipitation": Float64MultiArray, "forecast/evapotranspiration": Float64MultiArray,
}
tick = {}  # messages of the present tick, by topic


def on_message(topic, message):
    """Answer each tick once, when all of its inputs have arrived."""
    if topic in tick:
        raise SystemExit(f"second message on {topic} in one tick: is another graph running?")
    tick[topic] = message.data
    if len(tick) == len(INPUTS):
        publisher.publish(Float64(data=command()))
        if valve:
            valve.publish(Float64(data=opening()))
        tick.clear()


def command():
    """Return the share of the maximum flow, from 0 to 1."""
    cistern, roof = tick["cistern/level"], tick["roof/level"]
    if tick["weather/frost"] != 0 or not SUCTION <= cistern < math.inf or not math.isfinite(roof):
        return 0.0
    return min(max(GAIN * (TARGET - roof), 0.0), 1.0)


def opening():
    """Return the opening of the valve: 1 while the cistern is full, even in frost."""
    finite = all(map(math.isfinite, (tick["roof/level"], tick["weather/frost"])))
    return 1.0 if finite and FULL < tick["cistern/level"] < math.inf else 0.0


def end_with_plant():
    """Exit when the plant has ended; the clock is the first topic of the plant."""
    node.seen = node.seen or node.count_publishers("clock") > 0
    if node.seen and not node.count_publishers("clock"):
        raise SystemExit


rclpy.init()
node = rclpy.create_node("controller")
node.seen = False
qos = QoSProfile(depth=64, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # and reliable
for name, kind in INPUTS.items():
    node.create_subscription(kind, name, lambda message, name=name: on_message(name, message), qos)
qos.liveliness_lease_duration = Duration(seconds=1)  # lets a pump driver detect that this node died
publisher = node.create_publisher(Float64, "pump/command", qos)
has_valve = node.declare_parameter("valve", False).value
valve = node.create_publisher(Float64, "outlet/command", qos) if has_valve else None
node.create_timer(0.5, end_with_plant)
with suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(node)
