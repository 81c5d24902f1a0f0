"""What processes take of the machine, seen from outside, sample by sample."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

from graphs import files_of

# Before it a process is still loading (s).
_SETTLED_S = 60.0
_KIB_PER_MIB = 1024.0


@dataclass(frozen=True)
class Sample:
    """A process at one moment.

    Attributes:
        at: when (s, steady clock).
        memory: resident (MiB).
        threads: how many.
        files: how many descriptors are open, sockets included.
        sockets: how many of them are sockets.
    """

    at: float
    memory: float
    threads: int
    files: int
    sockets: int


@dataclass
class Life:
    """A process from its start to its end."""

    name: str
    pid: int
    began: float
    samples: list[Sample] = field(default_factory=list)


class Figures:
    """Samples of processes, each by its name and process id."""

    def __init__(self) -> None:
        self.lives: dict[int, Life] = {}

    def sample(self, pids: dict[str, int]) -> None:
        """Look at processes; one that has just ended is left out."""
        now = time.monotonic()
        for name, pid in pids.items():
            life = self.lives.setdefault(pid, Life(name, pid, now))
            try:
                status = dict(
                    line.split(":", 1)
                    for line in Path(f"/proc/{pid}/status").read_text().splitlines()
                )
                memory, threads = int(status["VmRSS"].split()[0]), int(status["Threads"])
            except (OSError, KeyError):
                continue
            files = files_of(pid)
            life.samples.append(Sample(
                now, memory / _KIB_PER_MIB, threads, len(files),
                sum(file.startswith("socket:") for file in files),
            ))

    def table(self) -> str:
        """Return a row for each name: its longest life, when it had settled and at its end."""
        lines = [
            "| process | lives | longest (min) | memory (MiB) | threads | files | sockets |",
            "|---|---|---|---|---|---|---|",
        ]
        for name in sorted({life.name for life in self.lives.values()}):
            lives = [life for life in self.lives.values() if life.name == name and life.samples]
            if not lives:
                continue
            longest = max(lives, key=lambda life: life.samples[-1].at - life.began)
            settled = [
                one for one in longest.samples if one.at - longest.began >= _SETTLED_S
            ] or longest.samples[-1:]
            first, last = settled[0], settled[-1]
            lines.append(
                f"| {name} | {len(lives)} | {(last.at - longest.began) / 60:.0f} "
                f"| {first.memory:.1f} → {last.memory:.1f} | {first.threads} → {last.threads} "
                f"| {first.files} → {last.files} | {first.sockets} → {last.sockets} |"
            )
        return "\n".join(lines)
