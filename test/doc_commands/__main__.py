"""Run the commands of README and documentation as written: ``python test/doc_commands [PAGE ...]``.

Each page in a copy of the checkout and in one shell, its blocks in order, as a reader types them
with ``.venv`` active. A command that never ends gets Ctrl-C once it is ready. What running a block
takes beside that, and why some are not run, stands in ``notes.yaml``. Exits with 1 where a command
fails, prints a traceback or leaves a process behind.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent.parent)]

from doc_commands.blocks import PAGES, Block, blocks_of, read_notes  # noqa: E402
from doc_commands.page import run_page  # noqa: E402
from doc_commands.terminal import Outcome  # noqa: E402

_LAST_LINES = 30


def _say(block: Block, outcome: Outcome | None) -> None:
    """Print how a block ended."""
    place = f"{block.page}:{block.line}"
    if outcome is None:
        print(f"not run           {place}  {block.first}\n{'':18}{block.note.not_run}", flush=True)
        return
    word = "FAILED" if outcome.failures else "done"
    print(f"{word:8}{outcome.seconds:7.1f} s {place}  {block.first}", flush=True)
    if outcome.failures:
        last = outcome.output.strip().splitlines()[-_LAST_LINES:]
        print("\n".join([*(f"    {each}" for each in outcome.failures),
                         *(f"    | {line}" for line in last)]), flush=True)


def main() -> int:
    """Run the blocks that the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "pages", nargs="*", metavar="PAGE", help="such as README.md (default: all)"
    )
    arguments = parser.parse_args()
    unknown = [page for page in arguments.pages if page not in PAGES]
    if unknown:
        parser.error(f"there is no page {unknown[0]}; the pages are {', '.join(PAGES)}")
    notes = read_notes()
    counts = {"run": 0, "failed": 0, "not run": 0}
    for page in arguments.pages or PAGES:
        blocks = blocks_of(page, notes)
        if not blocks:
            continue
        with tempfile.TemporaryDirectory(prefix="doc-commands-") as directory:
            for block, outcome in run_page(blocks, Path(directory)):
                _say(block, outcome)
                counts["not run" if outcome is None else "run"] += 1
                counts["failed"] += outcome is not None and bool(outcome.failures)
    print(
        f"{counts['run']} blocks run, {counts['failed']} failed; {counts['not run']} not run, each "
        "with its reason"
    )
    return 1 if counts["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
