"""Real graphs for the tests: their own ROS domain, real processes, and what they leave behind."""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import json
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, ClassVar

from commands import Forked
from mcap.reader import make_reader
from places import words_of

from greenroof_ros.base.processes import child_environment


@contextmanager
def reserved_domain() -> Iterator[int]:
    """Hold a ROS domain that no other test session or worker on this machine holds.

    Domains from 51 on are for studies.
    """
    for domain in range(1, 51):
        lock = Path(tempfile.gettempdir()) / f"greenroof_ros-test-domain-{domain}.lock"
        with lock.open("w") as stream:
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            yield domain
            return
    raise RuntimeError("every ROS domain from 1 to 50 is in use")


def environment(domain: int) -> dict[str, str]:
    """Return an environment for a separate graph on loopback."""
    rigs = Path(__file__).resolve().parent
    places = [str(place) for place in (rigs.parents[1], rigs.parent, rigs)]
    return {
        **os.environ,
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "PYTHONPATH": os.pathsep.join(
            filter(None, [*places, os.environ.get("PYTHONPATH", "")])
        ),
    }


def files_of(pid: int) -> list[str]:
    """Return what a process has open, by the kernel's names."""
    files = []
    with contextlib.suppress(OSError):  # the process has just ended
        for entry in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(OSError):
                files.append(str(entry.readlink()))
    return files


def udp_addresses_of(pid: int) -> list[str]:
    """Return the addresses to which a process has bound UDP sockets; none until it is a node."""
    sockets = set(files_of(pid))
    addresses = []
    for line in Path("/proc/net/udp").read_text().splitlines()[1:]:
        fields = line.split()
        if f"socket:[{fields[9]}]" in sockets:
            number = bytes.fromhex(fields[1].partition(":")[0])
            addresses.append(socket.inet_ntoa(number[::-1]))  # assumes a little-endian machine
    return addresses


def assert_on_loopback_alone(pid: int) -> None:
    """Check that a node listens only on 127.0.0.1 and uses no shared memory others could lock.

    Fast DDS calls its segments fastrtps_... and fast_datasharing_..., and their locks sem.fast...
    """
    assert set(udp_addresses_of(pid)) == {"127.0.0.1"}
    assert not [file for file in files_of(pid) if file.startswith("/dev/shm/")]
    maps = Path(f"/proc/{pid}/maps").read_text()
    assert "/dev/shm/fast" not in maps and "/dev/shm/sem.fast" not in maps


def _free_ports() -> Iterator[int]:
    """Yield free TCP ports, each once and in random order; the next higher port is free, too.

    All are below the range that the kernel gives to outgoing connections. Otherwise another test's
    connection could take a port before a simulator listens at it. The order is random per process,
    so that others that draw at the same moment draw other ports. The next port is for a simulator's
    workbench.
    """
    try:
        end = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()[0])
    except OSError:
        end = 0
    if end <= 11_000:  # the range is unknown, or leaves too few ports below it
        end = 32_768
    ports = list(range(10_000, end - 1, 2))
    random.SystemRandom().shuffle(ports)
    for port in ports:
        try:
            for number in (port, port + 1):
                socket.create_server(("127.0.0.1", number)).close()
        except OSError:
            continue
        yield port


_FREE_PORTS = _free_ports()


def free_ports(number: int) -> list[int]:
    """Return TCP ports that were free a moment ago: see `_free_ports`."""
    return list(itertools.islice(_FREE_PORTS, number))


def wait_for(condition: Callable[[], Any], seconds: float, event: str) -> Any:
    """Wait until a condition holds and return its value; a slow condition is checked less often.

    Reading a bag all the time would take a core from the process that is waited for.
    """
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        began = time.thread_time()
        value = condition()
        if value:
            return value
        time.sleep(max(0.02, 3 * (time.thread_time() - began)))
    raise AssertionError(f"{event} did not happen within {seconds:g} s")


def children_of(pid: int) -> list[int]:
    """Return the processes that the threads of a process have started."""
    children = list[int]()
    for file in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):  # the thread has just ended
            children += map(int, file.read_text().split())
    return children


class Process:
    """A command of this package as a user would start it, in a separate session."""

    started: ClassVar[list[Process]] = []

    def __init__(
        self, domain: int, module: str, *arguments: str, cwd: Path,
        stderr: int | None = None,
    ) -> None:
        """Start it; its standard error goes to a file unless given."""
        self.cwd = cwd
        number = len(list(cwd.glob("*.err")))
        self._out = (cwd / f"{number}-{module}.out").open("w+")
        self._err = (cwd / f"{number}-{module}.err").open("w+")
        self.process = Forked(
            [sys.executable, "-m", *words_of(module), *arguments],
            cwd=cwd, stdin=subprocess.DEVNULL, stdout=self._out,
            stderr=self._err if stderr is None else stderr,
            # If pytest's worker is killed, the graph ends with it.
            env={**child_environment(), **environment(domain)}, start_new_session=True,
        )
        self.started.append(self)

    @classmethod
    def end_all(cls) -> None:
        """End the processes that a failed test left running, and print their stderr for pytest."""
        for process in cls.started:
            print(f"{process.process.args}: {process._last_output()}")
            if process.process.poll() is None:
                process.process.send_signal(signal.SIGINT)
                process.wait(300)
        cls.started.clear()

    def nodes(self) -> dict[str, int]:
        """Return the process id of each node that this bringup started, or of all sensors'."""
        processes = {}
        for pid in children_of(self.process.pid):
            try:
                words = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
            except OSError:
                continue
            for word in words:
                if word.startswith(("greenroof_ros.nodes.", "greenroof_ros.live.")):
                    processes[word.rpartition(".")[2]] = pid
        return processes

    def until_printed(self, words: str, seconds: float = 60) -> None:
        """Wait until it has printed these words on its standard error."""
        wait_for(lambda: words in self.stderr(), seconds, f"{words!r} of {self.process.args}")

    def wait(self, seconds: float) -> int:
        """Wait until it ends, and return the exit code."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            for pid in [*self.nodes().values(), self.process.pid]:
                os.kill(pid, signal.SIGKILL)  # nodes first: a suspended bringup cannot end them
            raise AssertionError(f"still running after {seconds:g} s; {self.stderr()}") from None

    def _last_output(self) -> str:
        """Return the end of its standard error, even if its directory was moved."""
        number = self._err.fileno()
        tail = os.pread(number, 2000, max(0, os.fstat(number).st_size - 2000))
        return tail.decode(errors="replace")

    def stdout(self) -> str:
        return Path(self._out.name).read_text()

    def stderr(self) -> str:
        return Path(self._err.name).read_text()


def summary_of(run: Path) -> dict[str, Any]:
    """Return the summary that a run has written."""
    summary: dict[str, Any] = json.loads((run / "summary.json").read_text())
    return summary


def bag_file(run: Path) -> Path:
    """Return the MCAP file of a run."""
    return run / "bag" / "bag_0.mcap"


def messages_of(run: Path) -> dict[str, list[bytes]]:
    """Return each topic's messages in a run's closed bag as raw bytes; checksums must be right."""
    messages: dict[str, list[bytes]] = {}
    with bag_file(run).open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        for _, channel, message in reader.iter_messages(log_time_order=False):
            messages.setdefault(channel.topic, []).append(message.data)
    return messages


def bring_up(
    domain: int, cwd: Path, *arguments: str, output: str = "run", seconds: float = 900
) -> dict[str, Any]:
    """Run bringup, which must succeed, and return its summary; each topic has as many messages."""
    process = Process(domain, "bringup", "--output", output, *arguments, cwd=cwd)
    code = process.wait(seconds)
    assert code == 0, process.stderr()
    summary = summary_of(cwd / output)
    with bag_file(cwd / output).open("rb") as stream:
        index = make_reader(stream).get_summary()
    assert index is not None and index.statistics is not None
    counts = index.statistics.channel_message_counts
    assert summary["messages"] == {
        channel.topic: counts[number] for number, channel in index.channels.items()
    }
    assert len(set(counts.values())) == 1
    return summary


def alive(pid: int) -> bool:
    """Return whether a process still runs (a zombie does not)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


# --- nodes of users: the examples, with changes ---------------------------------------------------


def changed(text: str, old: str, new: str) -> str:
    assert text.count(old) == 1, old
    return text.replace(old, new)


def start_node(
    domain: int, directory: Path, name: str, source: str, *arguments: str
) -> subprocess.Popen[bytes]:
    """Start a node from its source, as its user would."""
    file = directory / f"{name}.py"
    file.write_text(source)
    return subprocess.Popen(
        [sys.executable, str(file), *arguments], cwd=directory, env=environment(domain)
    )
