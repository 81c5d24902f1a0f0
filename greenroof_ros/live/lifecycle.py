"""A node with the states of a ROS 2 lifecycle, which survives any transition request.

If the present state lacks a transition, the request is answered with ``success=false`` and a
warning; ``rclpy.lifecycle`` would end the node. If a transition fails, its reason is kept;
``rclpy.lifecycle`` hides it from ``on_error``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, cast

from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node

from greenroof_ros.graph.rclpy_internals import lifecycle_state, wrap_change_state

UNCONFIGURED, INACTIVE, ACTIVE = (
    State.PRIMARY_STATE_UNCONFIGURED, State.PRIMARY_STATE_INACTIVE, State.PRIMARY_STATE_ACTIVE,
)


class RefusedError(Exception):
    """A transition is not possible now; the message states why. The node keeps its state."""


class Transitions(Protocol):
    """What the transitions of a lifecycle do.

    The transition is made, and logged, unless its method raises. After :class:`RefusedError` the
    node keeps its state; any other exception leads to *unconfigured*, after :meth:`cleanup`. The
    reason is logged if it differs from the last one.
    """

    def requested(self) -> None:
        """Note that someone requests a transition."""

    def configure(self) -> None:
        """Do what leads from *unconfigured* to *inactive*."""

    def activate(self) -> None:
        """Do what leads from *inactive* to *active*."""

    def deactivate(self) -> None:
        """Do what leads from *active* to *inactive*."""

    def cleanup(self) -> None:
        """Do what leads from *inactive* to *unconfigured*, and from any state to *finalized*."""


class Lifecycle(LifecycleNodeMixin):
    """Mixin of a node, as rclpy's own. Topics do not depend on the state: none falls silent.

    Attributes:
        refusal: why the last transition was refused or failed; empty if it was made. A request for
            a transition that the state lacks does not change it.
    """

    def __init__(self, transitions: Transitions) -> None:
        """Open the services; the node itself must be initialised already."""
        self.refusal, self._transitions = "", transitions
        LifecycleNodeMixin.__init__(self)
        wrap_change_state(self, self._with_answer)

    @property
    def lifecycle_state(self) -> int:
        """The present state: ``UNCONFIGURED``, ``INACTIVE``, ``ACTIVE``, or *finalized*."""
        return lifecycle_state(self)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure."""
        return self._make("configure", self._transitions.configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Activate."""
        return self._make("activate", self._transitions.activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate."""
        return self._make("deactivate", self._transitions.deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Clean up."""
        return self._make("cleanup", self._transitions.cleanup)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Clean up, for good."""
        return self._make("shutdown", self._transitions.cleanup)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Clean up after an error and keep its reason, even if the cleanup fails, too."""
        why = self.refusal
        self.on_cleanup(state)
        self.refusal = why
        return TransitionCallbackReturn.SUCCESS

    def _make(self, name: str, transition: Callable[[], None]) -> TransitionCallbackReturn:
        """Make a transition, and keep and log why it fails."""
        log = cast(Node, self).get_logger()
        before, self.refusal = self.refusal, ""
        try:
            transition()
        except RefusedError as error:
            self.refusal, result = str(error), TransitionCallbackReturn.FAILURE
        except Exception as error:  # rclpy would hide the reason
            self.refusal = f"{type(error).__name__}: {error}"
            result = TransitionCallbackReturn.ERROR
        else:
            log.info(f"{name}: done")
            return TransitionCallbackReturn.SUCCESS
        if self.refusal != before:
            log.warning(self.refusal)
        return result

    def _with_answer(self, answer: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Wrap ``change_state``, so that it answers even if the state lacks the transition."""

        def on_request(request: ChangeState.Request, response: ChangeState.Response) -> Any:
            self._transitions.requested()
            try:
                return answer(request, response)
            except RuntimeError as error:  # from rcl: no such transition
                cast(Node, self).get_logger().warning(" ".join(str(error).split()))
                response.success = False
                return response

        return on_request
