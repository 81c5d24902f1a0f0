"""Make a notebook with its outputs from a script in percent format: python tools/notebook.py.

A line that begins with ``# %%`` starts a code cell, and ``# %% [markdown]`` starts a text cell.
"""

from __future__ import annotations

import base64
import re
import struct
import zlib
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

SCRIPT = Path(__file__).parents[1] / "examples" / "first_look.py"


def notebook_of(script: Path) -> nbformat.NotebookNode:
    """Return the notebook of a script, without outputs."""
    cells = []
    for kind, text in re.findall(r"^# %%(.*)\n((?:(?!# %%).*\n)*)", script.read_text(), re.M):
        cell = new_markdown_cell(re.sub("^# ?", "", text, flags=re.M).strip()) if kind else (
            new_code_cell(text.strip()))
        cell["id"] = f"cell-{len(cells)}"  # otherwise it would be different every time
        cells.append(cell)
    return new_notebook(cells=cells, metadata={"kernelspec": {
        "name": "python3", "display_name": "Python 3", "language": "python",
    }})


def executed(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Run a notebook and return it with its outputs; a cell that fails is an error."""
    done = NotebookClient(notebook, timeout=300, record_timing=False).execute()
    for cell in done.cells:
        for output in cell.get("outputs", ()):
            if "image/png" in output.data:
                picture = base64.b64decode(output.data["image/png"])
                output.data["image/png"] = base64.b64encode(packed(picture)).decode()
    return done


def packed(picture: bytes) -> bytes:
    """Return a PNG compressed as well as possible, which is a third of the size from Altair."""
    chunks, place = list[tuple[bytes, bytes]](), 8
    while place < len(picture):
        (length,) = struct.unpack_from(">I", picture, place)
        chunks.append((picture[place + 4:place + 8], picture[place + 8:place + 8 + length]))
        place += 12 + length
    pixels = zlib.decompress(b"".join(content for kind, content in chunks if kind == b"IDAT"))
    chunks = [chunk for chunk in chunks if chunk[0] != b"IDAT"]
    chunks.insert(-1, (b"IDAT", zlib.compress(pixels, 9)))
    return picture[:8] + b"".join(
        struct.pack(">I", len(content)) + kind + content
        + struct.pack(">I", zlib.crc32(kind + content)) for kind, content in chunks
    )


if __name__ == "__main__":
    nbformat.write(executed(notebook_of(SCRIPT)), SCRIPT.with_suffix(".ipynb"))
