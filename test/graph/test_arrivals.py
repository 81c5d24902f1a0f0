"""Of which process, and of which tick, the messages are that come to a node that joins."""

from __future__ import annotations

from greenroof_ros.graph.arrivals import Arrivals


def came(*messages: tuple[int, int, bytes]) -> Arrivals:
    """Return what came to a node that wants tick 9: number, time of publication, and content."""
    arrivals = Arrivals("/weather/frost")
    arrivals.next = 9
    for number, published, content in messages:
        arrivals.take(
            content, {"publication_sequence_number": number, "source_timestamp": published}
        )
    return arrivals


def test_what_the_process_before_said_is_forgotten() -> None:
    """It came before the new one said that it was silent, and has other numbers."""
    arrivals = came((10, 500, b"old"))
    arrivals.of_another(700)
    arrivals.first = 9
    arrivals.sort()
    assert not arrivals.due
    arrivals.take(b"new", {"publication_sequence_number": 1, "source_timestamp": 800})
    assert list(arrivals.due) == [b"new"]


def test_an_old_report_does_not_cost_what_was_said_after_it() -> None:
    """A node that joins late may be sent the report of a silent node behind its messages."""
    arrivals = came((9, 750, b"of tick 8"), (10, 800, b"of tick 9"))
    arrivals.of_another(700)
    arrivals.first = 0
    arrivals.sort()
    assert list(arrivals.due) == [b"of tick 9"]
    arrivals.take(b"of tick 10", {"publication_sequence_number": 11, "source_timestamp": 900})
    assert list(arrivals.due) == [b"of tick 9", b"of tick 10"]


def test_both_came() -> None:
    """Old and new ones before the report."""
    arrivals = came((10, 500, b"old"), (1, 800, b"new"))
    arrivals.of_another(700)
    arrivals.first = 9
    arrivals.sort()
    assert list(arrivals.due) == [b"new"]
