"""The controller node of a live site, which runs any controller on levels and forecasts.

On/off control replaces a controller that fails, or that needs a forecast when none is available.
``python -m greenroof_ros.live.controller --controller NAME`` runs a controller of this package, or
any class specified as ``package.module:Class``; the node is named after the controller.
"""

from __future__ import annotations

from greenroof_ros.base.interrupts import begin_program

begin_program(__name__)

import json
import math
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from greenroof_ros.base.disk import DISK
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_yaml, replace_text
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.processes import time_limit
from greenroof_ros.base.ranges import Range
from greenroof_ros.base.times import from_epoch_ns, to_people
from greenroof_ros.controllers.decide import ControllerError, locate_error, may_decide
from greenroof_ros.controllers.onoff import FRACTION, OnOff
from greenroof_ros.controllers.outlet import OutletPolicy
from greenroof_ros.controllers.protocol import set_optional
from greenroof_ros.controllers.registry import ControllerChoice, find_controller
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.live_input import RECOVERY, Levels, LiveInput, bad_inputs, live_parameters
from greenroof_ros.live.node import LiveNode, live_command
from greenroof_ros.live.upkeep import deciding_limit
from greenroof_ros.nodes.controller import FORECASTS, FROST, LEVELS, ControllerNode, Outputs
from greenroof_ros.ros.diagnostics import ERROR, WARN
from greenroof_ros.ros.parameters import declare, site_file

_CLOSE_S = 2.0
_FINITE = Range(-sys.float_info.max, sys.float_info.max)


class NumberFile:
    """A file of named numbers, of which only the latest count.

    The disk thread writes, because a disk may stop responding. The file is replaced as a whole, so
    that a power cut leaves either the old or the new file.
    """

    def __init__(self, file: Path) -> None:
        """Store the path of the file, which need not exist yet."""
        self._file, self._problem = file, ""

    @property
    def problem(self) -> str:
        """The reason why the latest numbers are not being written; empty for no problem."""
        return "the disk does not respond" if DISK.late else self._problem

    def write(self, values: Mapping[str, float]) -> None:
        """Queue numbers for writing; they replace those that have not been written yet."""
        self._values = values
        if not DISK.do(self._write_latest):
            self._problem = "the queue of the disk is full"

    def _write_latest(self) -> None:
        try:
            replace_text(self._file, json.dumps(self._values, indent=1), parents=True)
            self._problem = ""
        except Exception as error:  # whatever it is, the next numbers are still tried
            self._problem = str(error)

    def read(self) -> dict[str, float]:
        """Return the numbers in the file; an empty mapping if there is no file.

        Raises:
            ConfigurationError: if the file cannot be read, or is not a mapping of names to finite
                numbers.
        """
        if not self._file.exists():
            return {}
        return {
            name: _FINITE.read(value, key=name, file=self._file)
            for name, value in read_yaml(self._file).items()  # JSON is YAML
        }

    def close(self) -> None:
        """Wait at most two seconds until all numbers are written."""
        DISK.wait(_CLOSE_S)


_FLOW, _GAUGE, _HOLD = "/pump/flow", "/gauge/precipitation", "/pump/hold"
# Multiples of recovery_time: for how long the controller must have failed, or a forecast have been
# missing, before on/off control takes over, so that a short gap starts no pump; and how long after
# a failure the controller is tried again while on/off control commands.
_STAND_IN_AFTER, _RETRY_AFTER = 3, 60
# How long the import of its class, and then its first instantiation, which imports a solver, may
# each take (s). Both, and the start of ROS before them, fit into the 30 s for which a starting node
# may be silent.
_STARTING_S = 12.0
# How often learned values are saved (s).
_SAVE_S = 600.0
LIVE_PARAMETERS = live_parameters([*LEVELS, *FORECASTS, FROST, _FLOW, _GAUGE, _HOLD])
EXTERNAL_PUMP = Parameter(
    "external_pump", False, meaning="whether your own node runs the pump, which obeys /pump/hold",
)
LEARNED_FILE = Parameter(
    "state_file", "", meaning="file that preserves the cost of waiting for rain across restarts",
)


def parameters(choice: ControllerChoice | None) -> list[Parameter]:
    """Return the parameters of a controller's node; without a controller, the common parameters."""
    of_class = [] if choice is None else choice.kind.parameters
    return [site_file(), LEARNED_FILE, EXTERNAL_PUMP, *of_class, *LIVE_PARAMETERS]


class LiveControllerNode(ControllerNode, LiveNode):
    """Controller node of a live site, which commands even if its controller or a forecast fails.

    On/off control with default parameters takes over from a controller that needs a forecast but
    has no valid forecast, or whose code fails, that is, raises an error, does not return, or
    returns an invalid command. A failed controller is tried again at intervals of 60 times
    ``recovery_time``. When on/off control ends, the controller is restarted, since its
    knowledge of the roof and its plan are outdated. The cost of waiting for rain is stored in
    ``state_file``, and thus survives restarts of the node.

    If the node cannot run its controller, it exits. Bringup then restarts it, at most ten times in
    ten minutes.
    """

    _rain: LiveInput
    _evapotranspiration: LiveInput

    def __init__(self, controller: str) -> None:
        """Declare the controller's parameters and open the topics.

        Args:
            controller: name of the controller, or ``package.module:Class``.

        Raises:
            ConfigurationError: if there is no such controller.
        """
        choice = find_controller(controller)
        super().__init__(choice.name, "controller")
        with time_limit(_STARTING_S):
            _ = choice.kind
        self.prepare(choice)
        # The pump node alone limits how often the pump starts, and states when it may start next.
        self._site = replace(self._site, starts_per_hour=math.inf)
        values = declare(self, [LEARNED_FILE, EXTERNAL_PUMP, *LIVE_PARAMETERS])
        self._levels = Levels(
            self._site, values, self.subscribe, needs_roof=self._site.irrigated
        )
        self._cistern, self._roof = self._levels.cistern, self._levels.roof
        self._frost = self.subscribe(FROST)
        # Without the others, the node still commands.
        self._rain, self._evapotranspiration, self._flow, self._gauge = (
            self.subscribe(name, optional=True) for name in (*FORECASTS, _FLOW, _GAUGE)
        )
        self._hold = self.subscribe(_HOLD) if values[EXTERNAL_PUMP.name] else None
        self._stand_in = OnOff(self._site, FRACTION.default)
        self._stand_in_after = _STAND_IN_AFTER * values[RECOVERY.name]
        self._retry_after = _RETRY_AFTER * values[RECOVERY.name]
        self._failure, self._failed_at = "", -math.inf  # the controller's last (steady clock, s)
        self._stand_in_since = ""  # when on/off took over, in words; empty if not
        file = values[LEARNED_FILE.name]
        self._learned_file = NumberFile(Path(file)) if file else None
        self._learned: dict[str, float] = {}
        self._saved_at = time.monotonic()
        self._own_steps = choice.count_own_steps(self._site, self._values)
        if self._site.low_outlet_valve:
            self.open_outputs("/outlet/command")
        with self._keeping_learned():
            self._learned = self._learned_file.read() if self._learned_file is not None else {}
        with self._controllers_code(_STARTING_S):
            self.make_controller()
        # When the controller last worked, and had a forecast if it needs one (steady clock, s).
        self._worked_at = time.monotonic()

    # --- the controller's code ----------------------------------------------------------------

    @contextmanager
    def _controllers_code(self, limit: float) -> Iterator[None]:
        """Record an error in the controller's code, or a call that exceeds a time limit (s)."""
        try:
            with self.deciding(), time_limit(limit):
                yield
        except BaseException as error:  # signals do not raise exceptions in this process
            self._failure = str(locate_error(self._choice.kind, error))
            self._failed_at, self.controller = time.monotonic(), None

    def make_controller(self) -> None:
        """Create a new controller with the values that the previous controller had learned."""
        super().make_controller()
        # The node of the valve alone remembers when it rained.
        self._outlet = self._choice.make_outlet(
            self._site, self._values, self.controller, math.inf
        )
        if self._learned and getattr(self.controller, "learned", None) is not None:
            with self._keeping_learned():
                self.controller.learned = self._learned

    def _command_outlet(self, outlet: OutletPolicy) -> float:
        """Return the command to the valve; without a forecast, a plan is made without one.

        The valve needs no roof: an unknown level of the roof counts as its target.
        """
        fails = self.controller is None and not self._choice.of_valve
        if fails or not self._cistern.good:
            return 0.0
        roof = self._roof.value if self._roof.good else self._site.z_veg
        weather = [self._gauge.value if self._gauge.good else math.nan], ()
        if self._find_bad_forecast() is None:
            weather = self._rain.value, self._evapotranspiration.value
        with self._controllers_code(deciding_limit(self._site.tau)):
            return outlet(self._cistern.value, roof, *weather)
        return 0.0

    @contextmanager
    def _keeping_learned(self) -> Iterator[None]:
        """Log that learned values are lost, because they cannot be read or are of another class."""
        try:
            yield
        except (ConfigurationError, KeyError) as error:
            self.get_logger().warning(f"learned values are lost: {error}")

    def publish_outputs(self, outputs: Outputs) -> None:
        """Publish the optional outputs; one that cannot be published is the controller's fault."""
        with self._controllers_code(deciding_limit(self._site.tau)):
            super().publish_outputs(outputs)

    # --- decisions ----------------------------------------------------------------------------

    def find_command(self, allowed: bool) -> tuple[float, Outputs]:
        """Return the command of the controller or of on/off, and the former's optional outputs."""
        allowed = allowed and not (self._hold is not None and self._hold.value)
        command, outputs = 0.0, Outputs()
        may_retry = time.monotonic() - self._failed_at >= self._retry_after
        if not self._stand_in_since or (may_retry and allowed and self._may_use_forecast):
            with self._controllers_code(deciding_limit(self._site.tau)):
                command, outputs = self._command_by_controller(allowed)
        self._update_stand_in()
        self._save_learned(_SAVE_S)
        if self._stand_in_since:
            levels = self._cistern.value, self._roof.value
            command = self._stand_in.command(*levels, (), ())
        if self._quiet or not (allowed and self.good):
            command = 0.0
        # An unknown flow counts as 0, since the pump may be stopped: a constant level is then not
        # frozen.
        self._levels.expect(self._flow.value if self._flow.good else 0.0)
        return command, outputs

    def _command_by_controller(self, allowed: bool) -> tuple[float, Outputs]:
        """Return the controller's command and outputs.

        A forecast that the controller cannot use is rejected.
        """
        if self.controller is None:
            self.make_controller()
        allowed = may_decide(self.controller, allowed, self._quiet)
        decides = allowed and self._may_use_forecast
        measured = self._gauge.value if self._gauge.good else 0.0
        set_optional(self.controller, gauge_rain=measured)
        try:
            command, outputs = self.decide(decides)
        except ControllerError:
            raise
        except ConfigurationError as error:
            why = Diagnosis.of("input_refused", "refused", why=str(error))
            self._rain.refuse(why)  # any other error is the controller's
            decides = allowed and self._may_use_forecast
            command, outputs = self.decide(decides)
        learned = getattr(self.controller, "learned", None) or {}
        self._learned = {name: float(value) for name, value in learned.items()}
        if decides and time.monotonic() - self._failed_at >= self._stand_in_after:
            self._failure = ""
        return command, outputs

    @property
    def _may_use_forecast(self) -> bool:
        """Whether the controller has the forecasts that it needs, if it needs any."""
        return not self._choice.needs_forecast or self._find_bad_forecast() is None

    def _find_bad_forecast(self) -> Diagnosis | None:
        return bad_inputs((self._rain, self._evapotranspiration))

    # --- the stand-in -------------------------------------------------------------------------

    def _update_stand_in(self) -> None:
        """Switch to on/off control once the controller has failed to decide for too long.

        A failure and a problem with the forecasts are reported. A controller that can do without a
        forecast continues to issue commands; if the site never had a forecast, nothing is reported.
        """
        now = time.monotonic()
        if not self._failure and self._may_use_forecast:
            self._worked_at, self._stand_in_since = now, ""
        elif not self._stand_in_since and now - self._worked_at >= self._stand_in_after:
            began = from_epoch_ns(self.time_ns).replace(microsecond=0)
            self._stand_in_since = to_people(began)
        if self._stand_in_since:
            self.controller = None  # what it knows of the roof would be outdated
        since, bad, choice = self._stand_in_since, self._find_bad_forecast(), self._choice
        if self._failure or "command" in self.reports.parts:
            failed = Diagnosis.of(
                "controller_failed", "onoff" if since else "stops", why=self._failure, since=since
            ) if self._failure else None
            self.reports.diagnose(
                "command", failed, "the controller is in command again", WARN if since else ERROR
            )
        if choice.needs_forecast or ("horizon" in choice.parameters and self._rain.received):
            lacking = bad and Diagnosis.of(
                "no_forecast", "onoff" if since else "without", since=since, problem=bad.sentence,
                topic=bad.values["topic"],
            )
            cause = bad.code if bad else ""
            self.reports.diagnose("forecast", lacking, "the forecast is valid", WARN, cause)

    # --- what is kept and reported ------------------------------------------------------------

    def _save_learned(self, every: float) -> None:
        """Save the learned values if they were last saved at least ``every`` s ago."""
        now = time.monotonic()
        if self._learned_file is None or not self._learned or now - self._saved_at < every:
            return
        self._saved_at = now
        if problem := self._learned_file.problem:
            self.get_logger().warning(f"learned values are not saved: {problem}")
        self._learned_file.write(self._learned)

    def on_stop(self) -> None:
        """Save the values that the controller has learned."""
        self._save_learned(0.0)
        if self._learned_file is not None:
            self._learned_file.close()

    def progress(self) -> dict[str, Any]:
        """Return the changed parameters, and the levels (m), which bringup shows at the start."""
        levels = {"cistern_level": self._cistern, "roof_level": self._roof}
        return {
            **super().progress(),
            **{name: entry.value if entry.good else None for name, entry in levels.items()},
        }


main = live_command(LiveControllerNode, __doc__, "--controller")


if __name__ == "__main__":
    main()
