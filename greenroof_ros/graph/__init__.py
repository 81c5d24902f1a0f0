"""What puts nodes into a graph: lockstep, parameters, processes."""

import sys

# Each process that sends a message imports ROS's generator of Python code, a parser and templates
# with it, and uses none of it. Where it cannot be had, ROS goes on without: a tenth of a node's
# start.
sys.modules.setdefault("rosidl_generator_py.generate_py_impl", None)  # type: ignore[arg-type]
