"""Parts of a graph's nodes: messages, publishers, parameters, reports, lockstep, executables."""

from greenroof_ros.base.interrupts import begin_program


def begin_node(module: str) -> None:
    """Begin a node's program, before its module imports ROS 2 and all else that takes long.

    From then on, a signal ends the program, and without ROS 2 the program exits with a one-line
    error and code 2. Nothing is done if another program imports the module.

    Args:
        module: the module's ``__name__``.
    """
    if begin_program(module):
        from greenroof_ros.ros.domain import end_without_ros

        end_without_ros()
