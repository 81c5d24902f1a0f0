"""What survives a restart, a power cut, a full disk and a broken file."""

from __future__ import annotations

import math
import os
import threading
import zlib
from collections.abc import Callable
from pathlib import Path
from shutil import copytree, rmtree
from tempfile import TemporaryDirectory

import pytest
from disks import small_disk
from graphs import wait_for
from hypothesis import given, settings
from hypothesis import strategies as st
from paper import PAPER_SITE
from pump_rig import Rig, settings_for

from greenroof_ros.base.disk import DISK
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.processes import IN_MEMORY
from greenroof_ros.live.pumping import state_file as module
from greenroof_ros.live.pumping.pump_control import PumpControl
from greenroof_ros.live.pumping.state_file import StateFile, StoredState


class Clocks:
    """The clocks of a machine, set by hand: the system's, and the one since its latest boot."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.now, self.boots = 1_800_000_000.0, 0
        patch.setattr(module, "time", self)
        patch.setattr(module, "boot_time", lambda: self.now - 1e6 * self.boots)
        patch.setattr(module, "boot_id", lambda: f"boot {self.boots}")

    def time(self) -> float:
        return self.now


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Clocks:
    return Clocks(monkeypatch)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "site" / "pump.json"


def stored(file: Path) -> StoredState:
    """Return what the next process reads; the file stays as it is."""
    with TemporaryDirectory(dir=IN_MEMORY) as directory:
        copy = StateFile(copytree(file.parent, Path(directory) / "copy") / file.name)
        state = copy.state
        copy.close()
        return state


def hold_of(state: StoredState) -> tuple[str, str, float | None]:
    return state.hold_owner, state.hold_reason, state.hold_until


def held(file: Path) -> bytes:
    """Return the content of a file before someone holds the pump, and the file is closed."""
    state_file = StateFile(file)
    assert state_file.flush(20.0) == ""
    before = file.read_bytes()
    state_file.hold("the operator")
    assert state_file.close() == ""
    return before


def test_one_process_at_a_time_makes_the_file_and_writes_its_use_every_10_s(
    file: Path, clocks: Clocks
) -> None:
    """Made with its directories and in its final size."""
    state_file = StateFile(file)
    assert (state_file.state, state_file.flush(20.0)) == (StoredState(), "")
    assert state_file.saved and file.stat().st_size == 8192
    with pytest.raises(ConfigurationError, match=f"process {os.getpid()} holds the lock"):
        StateFile(file)
    state_file.switch(True)
    for _ in range(19):
        clocks.now += 1.0
        state_file.count(1.0, 0.01)
        state_file.check()
    assert DISK.wait(20.0)
    assert stored(file).day_volume == pytest.approx(0.1)
    state_file.close()
    StateFile(file).close()


@pytest.mark.parametrize(("boots", "elapsed", "run"), [(0, 4.0, 4.0), (1, 0.0, 25.0)])
def test_what_no_one_saw_counts_at_worst(
    boots: int, elapsed: float, run: float, file: Path, clocks: Clocks
) -> None:
    """Killed with the pump on: full flow since then, until the drive must have stopped (15 + 10 s).

    b sqrt(z_o + 55.2 - 13) = 1.29646769e-3 ... m3/s is the pump curve's maximum flow; Eq. (2).
    """
    state_file = StateFile(file)
    state_file.switch(True)
    state_file.close()
    clocks.now += 4.0
    clocks.boots += boots
    site = PAPER_SITE
    flow = site.b * math.sqrt(site.z_o + site.c_hat - site.d)
    for attempt in range(2):  # counted once only
        state_file = StateFile(file)
        PumpControl(site, settings_for(site), state_file, drive_stops_after=15.0)
        state_file.close()
        assert state_file.state.elapsed == elapsed, attempt
        assert state_file.state.day_volume == pytest.approx(run * flow, rel=1e-5), attempt


# --- holds ----------------------------------------------------------------------------------------


@given(st.lists(st.tuples(
    st.one_of(st.none(), st.integers(-50, 100)), st.integers(0, 100), st.sampled_from("ABC"),
)))
def test_a_later_request_never_shortens_a_hold(
    requests: list[tuple[int | None, int, str]]
) -> None:
    """It replaces owner and reason, and is told if it ends later; a past end does not count."""
    with pytest.MonkeyPatch.context() as patch:
        clocks, state_file, last = Clocks(patch), StateFile(None), -math.inf  # when the hold ends
        for after, passes, owner in requests:
            until = None if after is None else clocks.now + after
            end = math.inf if until is None else until
            last = max(end, last) if last > clocks.now else end
            assert state_file.hold(owner, owner, until) == (last == end)
            assert hold_of(state_file.state) == (owner, owner, None if last == math.inf else last)
            clocks.now += passes
            assert bool(state_file.active_hold) == (last > clocks.now)
        state_file.release()
        assert not state_file.active_hold


# --- kill -9, power cut, full and slow disk -------------------------------------------------------


texts = st.text(max_size=900)
changes = st.one_of(
    texts.map(lambda text: lambda kept: kept.hold("A", text)),
    texts.map(lambda text: lambda kept: kept.change(fault=text, fault_code="delivery")),
    st.floats(0, 1e6).map(lambda dt: lambda kept: kept.count(dt, 1e3 * dt)),
    st.sampled_from([
        lambda kept: kept.release(), lambda kept: kept.switch(True),
        lambda kept: kept.change(fault="", fault_code=""),
    ]),
)


@settings(max_examples=60, deadline=None)
@given(st.lists(changes, min_size=1, max_size=6), st.sets(st.integers(0, 15)))
def test_a_power_cut_forgets_no_hold(
    history: list[Callable[[StateFile], object]], sectors: set[int]
) -> None:
    """Whichever sectors of the last line reached the disk: the old state, the new, or unknown.

    Unknown is only cleared by a person, after which the file is as good as new.
    """
    with TemporaryDirectory(dir=IN_MEMORY) as directory:
        file, number = Path(directory) / "pump.json", Path(directory) / "pump.json.number"
        state_file = StateFile(file)
        for change in history[1:]:
            change(state_file)
        assert state_file.flush(20.0) == ""
        old, before, noted = stored(file), file.read_bytes(), number.read_bytes()
        history[0](state_file)
        assert state_file.flush(20.0) == ""
        new, after = stored(file), file.read_bytes()
        assert bool(new.hold_owner) == bool(state_file.state.hold_owner)
        assert bool(new.fault) == bool(state_file.state.fault)
        assert state_file.close() == ""
        file.write_bytes(b"".join(
            (after if sector in sectors else before)[512 * sector :][:512] for sector in range(16)
        ))
        number.write_bytes(noted)  # it is only written when the line is on the disk
        again = StateFile(file)
        torn = again.state.fault_code == "state_unknown"
        assert torn or (hold_of(again.state), again.state.fault) in (
            (hold_of(old), old.fault), (hold_of(new), new.fault)
        )
        again.release()
        assert again.flush(20.0) == ""
        assert (stored(file).fault_code == "state_unknown") == torn
        again.change(fault="")
        assert again.close() == "" and stored(file).fault == ""


def test_a_full_disk_loses_no_hold_and_keeps_the_control_running(tmp_path: Path) -> None:
    """Its space was reserved when the file was made; a file that could not be made is made later.
    """
    before, file = tmp_path / "disk/before.json", tmp_path / "disk/pump.json"
    with small_disk(tmp_path / "disk", "64k"):
        state_file, rubbish = StateFile(before), tmp_path / "disk/rubbish"
        assert state_file.flush(20.0) == ""
        with pytest.raises(OSError, match="No space left"):
            rubbish.write_bytes(b"x" * 100_000)
        state_file.hold("the page")
        assert state_file.flush(20.0) == "" and stored(before).hold_owner == "the page"
        state_file = StateFile(file)
        state_file.hold("the operator")
        assert "No space left on device" in state_file.flush(20.0)
        assert state_file.active_hold and not state_file.saved
        rubbish.unlink()
        wait_for(lambda: not state_file.check() and state_file.saved, 60, "it")
        assert (state_file.problem, state_file.close()) == ("", "")
        assert stored(file).hold_owner == "the operator"


def test_a_slow_disk_delays_no_stop(file: Path) -> None:
    """The answer says that it is not saved, then there is an alarm; it is written at the end."""
    rig, goes_on = Rig(file=file), threading.Event()
    assert rig.state_file.flush(20.0) == ""
    DISK.do(goes_on.wait)
    try:
        assert rig.run(30, 1.0).state == "running"
        rig.state_file.hold("the page")
        assert rig.state_file.flush() and rig.run(30, 1.0).at_rest
        late = f"{file} could not be written within 2 s"
        wait_for(lambda: rig.state_file.check() or rig.state_file.problem == late, 60, "the alarm")
    finally:
        goes_on.set()
    assert rig.state_file.close() == ""
    assert stored(file).hold_owner == "the page"


# --- damaged, missing, foreign and old files ------------------------------------------------------


# What a site of 30 November 2026 left in each line.
_OF_EARLIER_VERSION = (
    b'{"version":1,"sequence":%d,"hold_owner":"the operator","hold_reason":"a leak","hold_until":'
    b'null,"unknown":"","fault":"burst pipe","fault_code":"delivery","elapsed":105.0,"use":[[45.0,'
    b'0.32]],"starts":[100.0],"on":false,"boot":"aaf40da4-f566-433a-bc42-c1f31a07ab8c","boot_s":'
    b'64755.967595675}'
)


@pytest.mark.parametrize(("old", "new", "codes"), [
    (b"", b"", ["delivery", "hold"]),
    (b'"hold_owner"', b'"stopped"', ["state_unknown"]),  # a stop under another key
    (b'"version":1', b'"version":3', ["state_unknown"]),
])
def test_an_upgrade_keeps_the_state_or_the_pump_off(
    old: bytes, new: bytes, codes: list[str], file: Path
) -> None:
    """Each line has its checksum."""
    texts = [(_OF_EARLIER_VERSION % number).replace(old, new, 1) for number in (1, 2)]
    lines = [b"%08x %b" % (zlib.crc32(text), text) for text in texts]
    file.parent.mkdir()
    file.write_bytes(b"".join(line.ljust(4095) + b"\n" for line in lines))
    rig = Rig(file=file)
    assert ([*rig.run(30, 1.0).active], rig.decisions[-1].request) == (codes, None)
    assert old or rig.state_file.state.day_volume == 0.32
    assert rig.state_file.close() == ""


@pytest.mark.parametrize(
    "content", [None, "of before", "of another site", "cut", b"", b"[" * 8192]
)
def test_a_hold_is_not_forgotten_with_its_file(
    content: str | bytes | None, tmp_path: Path
) -> None:
    """The pump stays off until someone resets it, who must look at the pump first.

    A cleaner removed or emptied the file, or a restore put back an older copy or another site's.
    """
    file, other = tmp_path / "here" / "pump.json", tmp_path / "there" / "pump.json"
    before = held(file)
    held(other)
    now = file.read_bytes()
    file.unlink()
    if content is not None:
        file.write_bytes({
            "of before": before, "of another site": other.read_bytes(), "cut": now[:5000],
        }.get(content, content))  # type: ignore[call-overload]
    for _ in range(2):  # likewise at the next start
        rig = Rig(file=file)
        decision = rig.run(30, 1.0)
        assert (decision.request, next(iter(decision.active))) == (None, "state_unknown")
        assert rig.state_file.close() == ""
    rig = Rig(file=file)
    rig.state_file.release()
    rig.clear()
    assert rig.run(30, 1.0).state == "running"
    rig.state_file.close()
    assert stored(file).fault == ""


@pytest.mark.parametrize("removed", ["pump.json", "pump.json.number", "."])
def test_what_is_removed_is_made_anew_within_a_minute(
    removed: str, file: Path, clocks: Clocks
) -> None:
    """A cleaner wipes the files, or their whole directory: a hold is kept, also by kill -9."""
    state_file = StateFile(file)
    state_file.hold("the operator")
    assert state_file.flush(20.0) == ""
    gone = file.parent / removed
    gone.unlink() if gone.is_file() else rmtree(gone)
    clocks.now += 60.0
    state_file.check()
    assert DISK.wait(20.0)
    assert (stored(file).hold_owner, stored(file).fault) == ("the operator", "")
