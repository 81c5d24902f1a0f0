"""The topics of a bag according to msg_defs/topics.yaml, without the package's own reader."""

from __future__ import annotations

import yaml
from places import CHECKOUT


def bag_topics(*outputs: str) -> set[str]:
    """Return the topics recorded at each tick without a valve, and these optional ones."""
    topics = yaml.safe_load((CHECKOUT / "msg_defs" / "topics.yaml").read_text())["topics"]
    return {
        name
        for name, entry in topics.items()
        if entry["per_tick"] and (
            name in outputs or not (entry.get("optional") or entry.get("needs"))
        )
    }


# Topics of a run with mpc.
MPC_TOPICS = bag_topics("/controller/cost", "/controller/solver_status")
