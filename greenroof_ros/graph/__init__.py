"""Parts of a graph's nodes: messages, publishers, parameters, reports, lockstep, executables."""

import sys

# Every process that sends a message imports ROS's generator of Python code, with a parser and
# templates, and never uses it. ROS works without it: this blocks the import and saves a tenth of a
# node's start time.
sys.modules.setdefault("rosidl_generator_py.generate_py_impl", None)  # type: ignore[arg-type]
