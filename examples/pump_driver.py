"""A pump driver in the place of the simulated pump: /pump/command in, /pump/flow out.

It needs nothing but rclpy. Start it, then bringup with ``--pump external``; start it again for each
run. This pump's flow follows the command with a lag of first order.
"""

import math

import rclpy
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Float64

MAX_FLOW, LAG, TICK = 0.008, 30.0, 1.0  # of this pump: m3/s, s; of the graph: s


def on_command(message):
    """Follow a command, and publish the flow (m3/s)."""
    command = min(message.data, 1.0) if 0.0 <= message.data < math.inf else 0.0  # not a NaN
    flow.data += (command * MAX_FLOW - flow.data) * (1 - math.exp(-TICK / LAG))
    publisher.publish(flow)


def on_liveliness(event):
    """Stop the pump: the controller has ended, was killed, or hangs."""
    if event.alive_count == 0:
        raise SystemExit("stopped: no controller")


rclpy.init()
node, flow = rclpy.create_node("pump"), Float64()
qos = QoSProfile(depth=64, durability=DurabilityPolicy.TRANSIENT_LOCAL)
qos.liveliness_lease_duration = Duration(seconds=1)
publisher = node.create_publisher(Float64, "pump/flow", qos)
events = SubscriptionEventCallbacks(liveliness=on_liveliness)
node.create_subscription(Float64, "pump/command", on_command, qos, event_callbacks=events)
rclpy.spin(node)
