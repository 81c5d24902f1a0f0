"""Vega, which draws the page's charts, out of a library that has it: no internet is needed."""

from __future__ import annotations

import gzip
import os
import subprocess
import sys
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

from greenroof_ros.common.processes import asked_to_end_with_this

_MAKE = """
import sys
from greenroof_ros.common.processes import end_with_parent
end_with_parent()
import vl_convert
sys.stdout.write(vl_convert.javascript_bundle())
"""


def charts_script() -> bytes:
    """Return the script, compressed by gzip.

    To put it together takes five seconds of a core and 100 MB, so that a process of its own does,
    and once only: it is kept in the user's directory for what can be made again.

    Raises:
        OSError: it cannot be made here, or
        subprocess.SubprocessError: that failed, or
        ImportError: vl_convert is not here.
    """
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    kept = caches / "greenroof_ros" / f"vega-{version('vl-convert-python')}.js.gz"
    try:
        return kept.read_bytes()
    except OSError:
        script = _make()
    part = kept.with_suffix(f".{os.getpid()}")
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(script)
        part.replace(kept)
    except OSError:  # a full disk, or a user without a home: made again the next time
        with suppress(OSError):
            part.unlink()
    return script


def _make() -> bytes:
    done = subprocess.run(
        [sys.executable, "-c", _MAKE], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        check=True, env=asked_to_end_with_this(),
    )
    return gzip.compress(done.stdout)
