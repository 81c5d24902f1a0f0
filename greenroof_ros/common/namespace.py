"""The namespace of a graph, as an option of a command."""

from __future__ import annotations

import re


def namespace(text: str) -> str:
    """Return a namespace as ROS writes it, ``/site1``; empty for none."""
    name = text.strip("/")
    if name and not re.fullmatch(r"([A-Za-z_]\w*/)*[A-Za-z_]\w*", name, re.ASCII):
        raise ValueError
    return f"/{name}" if name else ""


# argparse puts it into its message
namespace.__name__ = "namespace: letters, digits and _, no digit first, such as site1"
