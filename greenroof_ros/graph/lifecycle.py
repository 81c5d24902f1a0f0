"""A node with the states of a ROS 2 lifecycle, which lives on whatever transition it is asked for.

A transition that the present state lacks is answered with ``success=false`` and a warning, where
``rclpy.lifecycle`` ends the node; one that fails leaves its reason, which that keeps from
``on_error``.
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
    """A transition cannot be made now; the message says why. The node stays in its state."""


def transition(
    step: Callable[[Any], None],
) -> Callable[[Any, LifecycleState], TransitionCallbackReturn]:
    """Make a method one of rclpy's, such as ``on_activate``: made unless it raises.

    It is logged, with the reason where that is another one than last time.
    :class:`RefusedError` leaves the node in its state, what else is raised leads to
    *unconfigured*, after ``on_cleanup``.
    """

    @wraps(step)
    def on_transition(node: Lifecycle, state: LifecycleState) -> TransitionCallbackReturn:
        log = cast(Node, node).get_logger()
        before, node.refusal = node.refusal, ""
        try:
            step(node)
        except RefusedError as error:
            node.refusal, result = str(error), TransitionCallbackReturn.FAILURE
        except Exception as error:  # rclpy would keep its reason from everybody
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
    """Mixin of a node, beside :class:`greenroof_ros.graph.link.LinkedNode`.

    Topics stay as they are: none is silent in any state. A node overrides ``on_configure`` and the
    others of rclpy by a :func:`transition`.

    Attributes:
        refusal: why the last transition was refused or failed; empty where it was made. One that
            the state lacks does not count.
    """

    def __init__(self) -> None:
        """Open the services; the node itself must be initialised already."""
        self.refusal = ""
        LifecycleNodeMixin.__init__(self)
        wrap_change_state(self, self._answered)

    @property
    def lifecycle_state(self) -> int:
        """The present one: ``UNCONFIGURED``, ``INACTIVE``, ``ACTIVE``, or *finalized*."""
        return lifecycle_state(self)

    def on_asked(self) -> None:
        """Note that somebody asked for a transition."""

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go after an error, whose reason stays; what failed once may fail again."""
        why = self.refusal
        self.on_cleanup(state)
        self.refusal = why
        return TransitionCallbackReturn.SUCCESS

    def _answered(self, answer: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Have ``change_state`` answered also where the state lacks the transition."""

        def on_request(request: ChangeState.Request, response: ChangeState.Response) -> Any:
            self.on_asked()
            try:
                return answer(request, response)
            except RuntimeError as error:  # of rcl
                cast(Node, self).get_logger().warning(" ".join(str(error).split()))
                response.success = False
                return response

        return on_request
