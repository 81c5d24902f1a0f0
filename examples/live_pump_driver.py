"""A pump driver for a live site, which needs only rclpy: ``greenroof live ... --pump external``."""

import math
import time

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Float64
from std_srvs.srv import SetBool

MAX_FLOW, RAMP = 0.008, 5.0  # maximum flow (m3/s), time from standstill to full speed (s)
SUCTION = 0.75  # cistern level at or below which the pump runs dry (m)
# The inputs, and the age at which each is too old (s): the pump then stops.
AGES = {"pump/command": 2.0, "cistern/level": 5.0, "roof/level": 5.0, "weather/frost": 60.0}


class PumpDriver(Node):
    """Follows the command while all inputs are known; publishes the flow ten times a second."""

    def __init__(self):
        super().__init__("my_pump")
        self.flow, self.held, self.commanders, self.received = 0.0, False, 0, {}
        sensor = QoSProfile(depth=1)
        for name in list(AGES)[1:]:
            self.create_subscription(Float64, name, lambda m, n=name: self.receive(n, m), sensor)
        # A lease of one second shows at once that the controller or this driver has died.
        lease = QoSProfile(depth=1, liveliness_lease_duration=Duration(seconds=1))
        self.create_subscription(
            Float64, "pump/command", lambda m: self.receive("pump/command", m), lease,
            event_callbacks=SubscriptionEventCallbacks(liveliness=self.on_liveliness),
        )
        lease = QoSProfile(depth=64, durability=DurabilityPolicy.TRANSIENT_LOCAL,
                           liveliness_lease_duration=Duration(seconds=1))
        self.publisher = self.create_publisher(Float64, "pump/flow", lease)
        # A hold of the site arrives here, whatever the controller commands.
        self.create_service(SetBool, "~/stop", self.on_stop)
        self.create_timer(0.1, self.act, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def receive(self, name, message):
        """Note the newest value of an input, and when it came."""
        self.received[name] = message.data, time.monotonic()

    def on_liveliness(self, event):
        """Count the controllers that are alive."""
        self.commanders = event.alive_count

    def on_stop(self, request, response):
        """Hold the pump, or end the hold."""
        self.held = request.data
        response.success, response.message = True, "held" if self.held else "released"
        return response

    def act(self):
        """Send the speed to your own pump here, and read its flow."""
        now = time.monotonic()
        command, cistern, roof, frost = (
            value if now - at < AGES[name] else math.nan
            for name, (value, at) in ((n, self.received.get(n, (0.0, -math.inf))) for n in AGES)
        )
        well = self.commanders == 1 and cistern > SUCTION and not math.isnan(roof) and frost == 0
        if self.held or not well or not 0 <= command < math.inf:
            command = 0.0
        target, step = min(command, 1.0) * MAX_FLOW, 0.1 / RAMP * MAX_FLOW
        self.flow += min(max(target - self.flow, -step), step)
        self.publisher.publish(Float64(data=self.flow))


rclpy.init()
driver = PumpDriver()
try:
    rclpy.spin(driver)
except (KeyboardInterrupt, ExternalShutdownException):  # SIGINT, SIGTERM: stop your own pump
    pass
except RuntimeError:  # SIGTERM just as rclpy begins to wait
    if rclpy.ok():
        raise
