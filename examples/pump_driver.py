"""A pump driver that needs only rclpy. Start it before every run with ``--pump external``."""

import math

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Float64

MAX_FLOW, LAG, TICK = 0.008, 30.0, 1.0  # maximum flow (m3/s), first-order lag (s), tick (s)
SILENCE = 3.0  # time without a command after which the pump stops (s)
SUCTION = 0.75  # cistern level at or below which the pump runs dry (m)
INPUTS = "pump/command", "cistern/level", "roof/level", "weather/frost"
tick = {}  # messages of the present tick, by topic


def on_message(topic, message):
    """Follow the command once all messages of a tick have arrived; publish your pump's flow."""
    tick[topic] = message.data
    if len(tick) < len(INPUTS):
        return
    watchdog.reset()
    command, cistern, roof, frost = map(tick.pop, INPUTS)
    command = min(command, 1.0) if 0.0 <= command < math.inf else 0.0  # not a NaN
    dry = not cistern > SUCTION  # an unknown level, NaN, counts as dry
    if node.commanders > 1 or dry or math.isnan(roof) or frost != 0:
        command = 0.0
    flow.data += (command * MAX_FLOW - flow.data) * (1 - math.exp(-TICK / LAG))
    publisher.publish(flow)


def on_silence():
    """Stop the pump, since no command has arrived. Here, send 0 to your own pump."""
    flow.data = 0.0


def on_liveliness(event):
    """Count the controllers. If the last one has ended, died or hung, send 0 to your pump."""
    node.commanders = event.alive_count
    if event.alive_count == 0:
        print("stopped: no controller")
        raise SystemExit


rclpy.init()
node, flow = rclpy.create_node("pump"), Float64()
node.commanders = 0
qos = QoSProfile(depth=64, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # and reliable
for name in INPUTS[1:]:
    node.create_subscription(Float64, name, lambda msg, name=name: on_message(name, msg), qos)
qos.liveliness_lease_duration = Duration(seconds=1)
publisher = node.create_publisher(Float64, "pump/flow", qos)
watchdog = node.create_timer(SILENCE, on_silence, clock=Clock(clock_type=ClockType.STEADY_TIME))
events = SubscriptionEventCallbacks(liveliness=on_liveliness)
node.create_subscription(
    Float64, INPUTS[0], lambda msg: on_message(INPUTS[0], msg), qos, event_callbacks=events
)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):  # SIGINT, SIGTERM: send 0 to your pump
    pass
except RuntimeError:  # SIGTERM just as rclpy begins to wait
    if rclpy.ok():
        raise
