"""A node with the states of a ROS 2 lifecycle, which lives on whatever transition it is asked for.

``rclpy.lifecycle`` ends the node with an exception where the present state lacks a transition, a
second *activate* perhaps (rclpy issue 1209), and keeps from ``on_error`` what the error was. Here
such a request is answered with ``success=false`` and a warning, and a transition that fails leaves
its reason.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node

UNCONFIGURED, INACTIVE, ACTIVE, FINALIZED = (
    State.PRIMARY_STATE_UNCONFIGURED, State.PRIMARY_STATE_INACTIVE, State.PRIMARY_STATE_ACTIVE,
    State.PRIMARY_STATE_FINALIZED,
)
CONFIGURE, ACTIVATE = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE
_DONE, _FAILED = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class RefusedError(Exception):
    """A transition cannot be made now; the message says why. The node stays in its state."""


class Lifecycle(LifecycleNodeMixin):
    """Mixin of a node, beside :class:`greenroof_ros.graph.link.LinkedNode`.

    Topics stay as they are: none is silent in any state. A node overrides ``configure``,
    ``activate``, ``deactivate`` and ``clean_up``; the first two may raise :class:`RefusedError`.
    What else one of them raises leads to *unconfigured*, after ``clean_up``.

    Attributes:
        refusal: why the last transition was refused or failed; empty where it was made. One that
            the state lacks does not count.
    """

    def __init__(self) -> None:
        """Open the services; the node itself must be initialised already."""
        self.refusal = ""
        self._log = cast(Node, self).get_logger()
        LifecycleNodeMixin.__init__(self)
        self._service_change_state.callback = self._on_request

    # --- to override ------------------------------------------------------------------------

    def configure(self) -> None:
        """Make ready for work, and do none."""

    def activate(self) -> None:
        """Begin to work."""

    def deactivate(self) -> None:
        """Do no more work."""

    def clean_up(self) -> None:
        """Let go of all that ``configure`` took, or a part of it."""

    def on_asked(self) -> None:
        """Note that somebody asked for a transition."""

    # --- states -----------------------------------------------------------------------------

    @property
    def lifecycle_state(self) -> int:
        """The present one: ``UNCONFIGURED``, ``INACTIVE``, ``ACTIVE`` or ``FINALIZED``."""
        return int(self._state_machine.current_state[0])

    def change(self, transition: int) -> bool:
        """Make a transition of ``lifecycle_msgs/msg/Transition``, and return whether it was made.

        Why not is in :attr:`refusal`, and logged where it is another reason than last time.
        """
        machine = self._state_machine
        possible = {number: label for number, label, *_ in machine.available_transitions}
        if transition not in possible:
            self._log.warning(
                f"transition {transition} is none of state {machine.current_state[1]}, "
                f"which has {', '.join(sorted(set(possible.values()))) or 'none'}"
            )
            return False
        before, self.refusal = self.refusal, ""
        if _TRIGGERS[transition](self) == _DONE:
            self._log.info(f"{possible[transition]}: done")
            return True
        if self.refusal != before:
            self._log.warning(self.refusal)
        return False

    def _on_request(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        """Answer ``change_state``; a label, where there is one, comes before the number."""
        self.on_asked()
        number = request.transition.id
        if request.transition.label:
            number = next(
                (
                    each[0] for each in self._state_machine.available_transitions
                    if each[1] == request.transition.label
                ),
                Transition.TRANSITION_CALLBACK_ERROR,  # nobody can ask for it
            )
        response.success = self.change(number)
        return response

    # --- what rclpy calls -------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure, or stay unconfigured."""
        return self._try(self.configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Activate, or stay inactive."""
        return self._try(self.activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate."""
        return self._try(self.deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go."""
        return self._try(self.clean_up)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go, for good."""
        return self._try(self.clean_up)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go after an error, whose reason stays."""
        try:
            self.clean_up()
        except Exception as error:  # what failed once may fail again
            self._log.error(f"letting go failed, too: {error}")
        return _DONE

    def _try(self, step: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            step()
        except RefusedError as error:
            self.refusal = str(error)
            return _FAILED
        except Exception as error:  # rclpy would keep its reason from everybody
            self.refusal = f"{type(error).__name__}: {error}"
            return TransitionCallbackReturn.ERROR
        return _DONE


_TRIGGERS: dict[int, Callable[[Any], TransitionCallbackReturn]] = {
    CONFIGURE: Lifecycle.trigger_configure,
    Transition.TRANSITION_CLEANUP: Lifecycle.trigger_cleanup,
    ACTIVATE: Lifecycle.trigger_activate,
    Transition.TRANSITION_DEACTIVATE: Lifecycle.trigger_deactivate,
    Transition.TRANSITION_UNCONFIGURED_SHUTDOWN: Lifecycle.trigger_shutdown,
    Transition.TRANSITION_INACTIVE_SHUTDOWN: Lifecycle.trigger_shutdown,
    Transition.TRANSITION_ACTIVE_SHUTDOWN: Lifecycle.trigger_shutdown,
}
