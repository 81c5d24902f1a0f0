"""Parts of a graph's nodes: messages, publishers, parameters, reports, lockstep, executables."""

from greenroof_ros.base.interrupts import begin_program as begin_node

__all__ = ["begin_node"]
