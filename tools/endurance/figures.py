"""Resources that processes use, sampled from outside."""

from __future__ import annotations

import time
from pathlib import Path

import polars as pl
from graphs import files_of
from markdown_tables import head, row

# Age before which a process is still loading (s).
_SETTLED_S = 60.0
_KIB_PER_MIB = 1024.0


class Figures:
    """Samples of processes: resident memory (MiB), threads, open files, and sockets among these."""

    def __init__(self) -> None:
        self._samples: list[dict[str, object]] = []

    def sample(self, pids: dict[str, int]) -> None:
        """Sample processes, given by name; a process that has just ended is left out."""
        now = time.monotonic()
        for name, pid in pids.items():
            try:
                status = dict(
                    line.split(":", 1)
                    for line in Path(f"/proc/{pid}/status").read_text().splitlines()
                )
                memory, threads = int(status["VmRSS"].split()[0]), int(status["Threads"])
            except (OSError, KeyError):
                continue
            files = files_of(pid)
            self._samples.append({
                "process": name, "pid": pid, "at": now, "memory": memory / _KIB_PER_MIB,
                "threads": threads, "files": len(files),
                "sockets": sum(file.startswith("socket:") for file in files),
            })

    def table(self) -> str:
        """Return a row for each name: its longest life, once settled and at its end."""
        samples = pl.DataFrame(self._samples).sort("process", "at").with_columns(
            age=pl.col("at") - pl.col("at").min().over("pid")
        )
        lines = [head([
            "process", "lives", "longest (min)", "memory (MiB)", "threads", "files", "sockets",
        ])]
        for (name,), of_name in samples.group_by("process", maintain_order=True):
            longest = of_name.filter(pl.col("pid") == of_name.sort("age")["pid"][-1])
            last = longest.row(-1, named=True)
            settled = longest.filter(pl.col("age") >= _SETTLED_S)
            first = settled.row(0, named=True) if len(settled) else last
            lines.append(row([
                str(name), str(of_name["pid"].n_unique()), f"{last['age'] / 60:.0f}",
                f"{first['memory']:.1f} → {last['memory']:.1f}",
                *(f"{first[key]} → {last[key]}" for key in ("threads", "files", "sockets")),
            ]))
        return "\n".join(lines)
