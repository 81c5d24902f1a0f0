"""``greenroof status``, in the page's words; what hold, release and outlet request, of whom."""

from __future__ import annotations

import sys
import time
from unittest.mock import MagicMock

import pytest
from page_inputs import add_values, alarm, pump, store
from paper import PAPER_SITE

from greenroof_ros.__main__ import COMMANDS
from greenroof_ros.commands import requests
from greenroof_ros.commands.status import _judge, _write_lines
from greenroof_ros.interface.alarm import WARN
from greenroof_ros.watch.document import make_document
from greenroof_ros.watch.store import GraphStore


def test_it_gives_the_pages_words() -> None:
    """Of each alarm what to do."""
    lost = "\x1b[31mno answer"
    graph = store(
        "live", PAPER_SITE, alarm("/roof_sensor: sensor", "roof_sensor", "sensor_lost", lost),
        alarm("/pump: 1", "pump", "x", "odd", WARN),
    )
    graph.add_statuses(100.0, 0, pump("held: frost"))
    page = make_document(graph, 100.0)
    lines = _write_lines(page, _judge(page))
    assert (_judge(page), len(lines)) == (2, 11) and all(map(str.isprintable, lines))
    assert lines[0] == "1 alarm, 1 warning. Roof sensor: \\x1b[31mno answer; pump: off."
    assert lines[5] == f"{'Pump':14} {'off':14} frost"
    first = "Alarm. Roof sensor: \\x1b[31mno answer since 05:00. "
    assert lines[9] == first + page["alarms"][0]["do"]


@pytest.mark.parametrize(("mode", "code"), [("live", 2), ("simulated", 1)])
def test_an_unknown_value_is_a_warning_or_without_alarms_one(mode: str, code: int) -> None:
    """An alarm at a live site only if the alarms are unknown, too; a site that is gone is one."""
    graph = store(mode)
    add_values(graph, 59, 60, {"/roof/level": 0.0457, "/cistern/level": 2.5, "/pump/command": 0.0})
    graph.add_statuses(100.0, 0, pump("off: x"))
    assert _judge(make_document(graph, 100.0)) == 0
    for name in ("roof", "cistern", "pump", "watering"):
        page = make_document(graph, 100.0)
        page["tiles"][name]["state"] = "unknown"
        assert [_judge(page | {"known": known}) for known in (True, False)] == [1, code], name
    graph = GraphStore()
    page = make_document(graph, 100.0)
    assert _judge(page) == 3 and len(_write_lines(page, 3)) == 1
    graph.seen_at = 1e9
    assert _judge(make_document(graph, 100.0)) == 2


@pytest.mark.parametrize(("name", "options", "made"), [
    ("hold", "--for 48", [("stop", "pump", 172_800)]), ("release", "", [("release", "pump", 0)]),
    ("outlet close", "--for 2d", [("stop", "valve", 172_800)]),
    ("outlet open", "--for 30min", [("open", "valve", 1800)]), ("outlet open", "--for 3x", []),
    ("outlet reset", "--yes", [("reset", "valve", 0)]),
])
def test_a_command_makes_its_request(
    monkeypatch: pytest.MonkeyPatch, name: str, options: str, made: list[tuple[str, str, int]]
) -> None:
    now, graph = time.time(), MagicMock()
    monkeypatch.setattr(requests, "GraphClient", graph)
    monkeypatch.setattr(sys, "argv", [name, *options.split()])
    with pytest.raises(SystemExit) as end:
        COMMANDS[name].load().main()
    calls = graph.return_value.request.call_args_list
    assert end.value.code == (0 if made else 2)
    assert [(action, role) for (action, _, role), _ in calls] == [each[:2] for each in made]
    for (_, given), (*_, seconds) in zip(calls, made, strict=True):
        assert given.get("until", now) == pytest.approx(now + seconds, abs=60)
