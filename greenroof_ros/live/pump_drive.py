"""The drive of a pump node, and the reasons against using it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from greenroof_ros.common.conditions import Problem
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.live.drives.drive import DriveStatus
from greenroof_ros.live.drives.drive_file import find_drive_file
from greenroof_ros.live.drives.endpoint import read_endpoint
from greenroof_ros.live.drives.exchange import DriveExchange, DriveSnapshot
from greenroof_ros.live.lifecycle import RefusedError

# The drive's thread stops the drive after this time without a call (s): this node hangs.
_DEAD_MAN_S = 1.0
# Greatest age of the drive's status (s). During a start none comes for some seconds; the exchange
# notices a lost connection sooner.
_DRIVE_AGE_S = 10.0


class PumpDrive:
    """The drive that the parameters choose, and the reasons against using it.

    Attributes:
        endpoint: its drive file and its address.
        exchange: the communication with it.
    """

    def __init__(
        self, values: Mapping[str, Any], node_name: str, *, checks_simulator: bool
    ) -> None:
        """Read the drive file.

        Args:
            values: values of the pump node's parameters.
            node_name: the node's name, for messages.
            checks_simulator: whether to find out if it is the drive simulator.

        Raises:
            ConfigurationError: a parameter or the file is wrong.
        """
        key = f"parameter {{}} of {node_name}"
        if not values["drive"]:
            raise ConfigurationError(
                "must be given: the make of the drive, as a file of config/drives without .yaml, "
                "or the path of your own file", key=key.format("drive"),
            )
        self.endpoint = read_endpoint(
            find_drive_file(values["drive"]), values["address"], key.format("address"),
            values["broker_login"], values["broker_authority"],
        )
        self._period = values["exchange_period"]
        self._limit = values["drive_timeout_limit"]
        self._stops_locally = values["local_settings_stop_the_pump"]
        self._checks_simulator = checks_simulator
        self._renew()

    def _renew(self) -> None:
        """Make a new exchange, not yet started."""
        self.exchange = DriveExchange(
            self.endpoint, self._period, _DEAD_MAN_S, timeout_limit_s=self._limit,
            checks_simulator=self._checks_simulator,
        )
        self._started = self._closing = False

    @property
    def snapshot(self) -> DriveSnapshot:
        """What is known of the drive."""
        return self.exchange.snapshot

    def connect(self) -> None:
        """Start the exchange, which keeps the drive stopped; a closing one must end first."""
        if self._closing and self.exchange.close(0.0):
            self._renew()
        if not self._started:
            self.exchange.start()
            self._started = True

    def disconnect(self, within: float) -> str:
        """Stop the drive and disconnect; return its last status, empty if there was no exchange.

        Args:
            within: longest wait (s); the longest ramp plus a few seconds is enough for any drive.

        Raises:
            RefusedError: it takes longer; stopping continues.
            OSError: the drive did not answer at the end, or is not at rest.
        """
        if not self._started:
            return ""
        self._closing = not self.exchange.close(within)
        if self._closing:
            raise RefusedError("the drive is still slowing down, or does not answer; ask again")
        snapshot = self.snapshot
        status = snapshot.status
        self._renew()
        problem = f"the drive is not at rest at the end: {status}"
        if status is None or snapshot.connected:
            # If still connected, the thread has not read that the drive is at rest.
            why = snapshot.problem or "no last answer"
            problem = f"the drive did not answer at the end ({why})"
        elif status.at_rest:
            return f"released the drive: {status}"
        timeout = "off" if snapshot.timeout_known else "not known"
        ending = f"only its own panel can stop it now: its communication timeout is {timeout}"
        if snapshot.timeout_s is not None:
            ending = f"its own timeout of {snapshot.timeout_s:g} s must stop it"
        raise OSError(f"{problem}; {ending}")

    def status(self, now: float) -> DriveStatus | None:
        """Return the drive's last status; None if too old."""
        snapshot = self.snapshot
        return snapshot.status if now - snapshot.read_at < _DRIVE_AGE_S else None

    def absence(self, now: float) -> Problem | None:
        """Return why the drive does not answer; None if it does."""
        if self._closing:
            return Problem.of("drive_lost", "released")
        if self.status(now) is not None:
            return None
        if problem := self.snapshot.problem:
            return Problem.of("drive_lost", "problem", problem=problem)
        return Problem.of("drive_lost", "silent", time=_DRIVE_AGE_S)

    def timeout_problem(self, snapshot: DriveSnapshot) -> Problem | None:
        """Return what is wrong with the drive's own communication timeout; None if nothing is."""
        guard, seconds = self.endpoint.guard, snapshot.timeout_s
        values: dict[str, float | str] = {}
        if not snapshot.timeout_known:
            case, values["note"] = "unread", snapshot.timeout_note
        elif seconds is None:
            case, values["note"] = "none", snapshot.timeout_note
        elif seconds > self._limit:
            case, values = "long", {"timeout": seconds, "limit": self._limit}
        elif guard is not None and guard.local_settings_decide and not self._stops_locally:
            case = "local"
        else:
            return None
        more = {} if guard is None else {"repair": guard.how_to_set, "traps": guard.traps}
        cases = [name for name, text in more.items() if text]
        return Problem.of("drive_timeout", case, *cases, **values, **more)
