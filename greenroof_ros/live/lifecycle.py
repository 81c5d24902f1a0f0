"""A node with the states of a ROS 2 lifecycle, which survives any transition request.

If the present state lacks a transition, the request is answered with ``success=false`` and a
warning; ``rclpy.lifecycle`` would end the node. If a transition fails, its reason is kept;
``rclpy.lifecycle`` hides it from ``on_error``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, cast

from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node

from greenroof_ros.graph.rclpy_internals import lifecycle_state, wrap_change_state

UNCONFIGURED, INACTIVE, ACTIVE = (
    State.PRIMARY_STATE_UNCONFIGURED, State.PRIMARY_STATE_INACTIVE, State.PRIMARY_STATE_ACTIVE,
)


class RefusedError(Exception):
    """A transition is not possible now; the message says why. The node keeps its state."""


def transition(
    step: Callable[[Any], None],
) -> Callable[[Any, LifecycleState], TransitionCallbackReturn]:
    """Turn a method into a transition callback of rclpy, such as ``on_activate``.

    The transition is made, and logged, unless the method raises. After :class:`RefusedError` the
    node keeps its state; any other exception leads to *unconfigured*, after ``on_cleanup``. The
    reason is logged if it differs from the last one.
    """

    @wraps(step)
    def on_transition(node: Lifecycle, state: LifecycleState) -> TransitionCallbackReturn:
        log = cast(Node, node).get_logger()
        before, node.refusal = node.refusal, ""
        try:
            step(node)
        except RefusedError as error:
            node.refusal, result = str(error), TransitionCallbackReturn.FAILURE
        except Exception as error:  # rclpy would hide the reason
            node.refusal = f"{type(error).__name__}: {error}"
            result = TransitionCallbackReturn.ERROR
        else:
            log.info(f"{step.__name__.removeprefix('on_')}: done")
            return TransitionCallbackReturn.SUCCESS
        if node.refusal != before:
            log.warning(node.refusal)
        return result

    return on_transition


class Lifecycle(LifecycleNodeMixin):
    """Mixin of a node, beside :class:`greenroof_ros.live.node.LiveNode`.

    Topics do not depend on the state: none falls silent. A node overrides ``on_configure`` and the
    other callbacks of rclpy with a :func:`transition`.

    Attributes:
        refusal: why the last transition was refused or failed; empty if it was made. A request for
            a transition that the state lacks does not change it.
    """

    def __init__(self) -> None:
        """Open the services; the node itself must be initialised already."""
        self.refusal = ""
        LifecycleNodeMixin.__init__(self)
        wrap_change_state(self, self._with_answer)

    @property
    def lifecycle_state(self) -> int:
        """The present state: ``UNCONFIGURED``, ``INACTIVE``, ``ACTIVE``, or *finalized*."""
        return lifecycle_state(self)

    def on_transition_request(self) -> None:
        """Called when a transition is requested; for a node to override."""

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Clean up after an error and keep its reason, even if the cleanup fails, too."""
        why = self.refusal
        self.on_cleanup(state)
        self.refusal = why
        return TransitionCallbackReturn.SUCCESS

    def _with_answer(self, answer: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Wrap ``change_state``, so that it answers even if the state lacks the transition."""

        def on_request(request: ChangeState.Request, response: ChangeState.Response) -> Any:
            self.on_transition_request()
            try:
                return answer(request, response)
            except RuntimeError as error:  # from rcl: no such transition
                cast(Node, self).get_logger().warning(" ".join(str(error).split()))
                response.success = False
                return response

        return on_request
