"""Runs the commands of README and the documentation: a page is one script of ``bash -e``.

A command is on the line of the script that it has on the page, so bash says where a page fails.
``doc_commands.yaml`` lists what is not run, and what else a page needs.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from places import CHECKOUT

PAGES = [
    "README.md", "CONTRIBUTING.md",
    *sorted(
        str(path.relative_to(CHECKOUT)) for path in (CHECKOUT / "doc").rglob("*.md")
        if "_build" not in path.parts
    ),
]
NOTES: dict[str, dict[str, dict[str, Any]]] = yaml.safe_load(
    Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8")
)
_FENCE = re.compile(r"^( *)```([^\n]*)\n(.*?)^\1```$", re.DOTALL | re.MULTILINE)
# Each command's place is printed before it runs, so the last place is of the one that failed.
# Job control lets what runs in the background receive SIGINT.
_FUNCTIONS = r"""
set -m
trap end EXIT

within() {  # SECONDS COMMAND...: whether the command succeeds within this time
    local until=$((SECONDS + $1)); shift
    until "$@"; do ((SECONDS < until)) || return 1; sleep 0.2; done
}

ended() { ! kill -0 "$1" 2>/dev/null; }

interrupt() {  # JOB: SIGINT, as by Ctrl-C; whether it then ends as it should
    local code=0
    kill -INT -- "-$1" 2>/dev/null
    within 30 ended "$1" || kill -KILL -- "-$1"
    wait "$1" || code=$?
    [[ $code =~ ^(0|130)$ ]] || { echo "exit code $code of a command in the background"; false; }
}

never_ends() {  # PRINTS THEN_S SAYS_NOT COMMAND...
    local prints=$1 then_s=$2 says_not=$3 output failed="" job; shift 3
    output=$(mktemp -p "$HOME")
    "$@" > "$output" 2>&1 &
    job=$!
    within 120 grep -qE -- "$prints" "$output" || failed="did not print $prints within 120 s"
    ! within "$then_s" ended "$job" || failed+=" ended by itself"
    interrupt "$job" || failed+=" after SIGINT"
    cat "$output"
    [[ -z $says_not ]] || ! grep -E -- "$says_not" "$output" || failed+=" printed $says_not"
    [[ -z $failed ]] || { echo "$failed"; false; }
}

end() {
    local code=$? job
    trap - DEBUG
    for job in $(jobs -p); do interrupt "$job" || code=1; done
    exit "$code"
}

trap '((LINENO == 1)) || echo "@ $page:$LINENO: $BASH_COMMAND"' DEBUG
"""


def fences(page: str) -> Iterator[tuple[int, str, str]]:
    """Yield the fenced blocks of a page: first line, language, text."""
    text = (CHECKOUT / page).read_text(encoding="utf-8")
    for match in _FENCE.finditer(text):
        indent, language, body = match.groups()
        yield text.count("\n", 0, match.start()) + 1, language, re.sub(
            f"^{indent}", "", body, flags=re.MULTILINE
        )


def script_of(page: str) -> dict[int, str]:
    """Return what a page runs: the commands by their lines on the page."""
    notes, script = NOTES.get(page, {}), {}
    for fence, language, text in fences(page):
        if language != "sh" or any(part in text for part in notes.get("not_run", ())):
            continue
        script[fence] = "".join(
            before for part, before in notes.get("before", {}).items() if part in text
        )
        for number, line in enumerate(text.splitlines(), fence + 1):
            script[number] = line
            for command, wait in notes.get("never_ends", {}).items():
                if line.startswith(command):
                    words = wait["prints"], str(wait.get("then_s", 0)), wait.get("says_not", "")
                    script[number] = f"never_ends {shlex.join(words)} {line}"
    return script


def _copy_checkout(to: Path) -> None:
    """Copy the files that a clone has; ``.venv`` is a link to the checkout's."""
    hidden = shutil.ignore_patterns(".?*", "__pycache__", "_build")
    made = shutil.ignore_patterns("runs", "studies", "build", "install", "log")
    shutil.copytree(CHECKOUT, to, ignore=lambda folder, names: (
        hidden(folder, names) | (made(folder, names) if Path(folder) == CHECKOUT else set())
    ))
    (to / ".venv").symlink_to(Path(sys.prefix))


def run(page: str, script: dict[int, str], directory: Path, domain: int) -> list[str]:
    """Run what a page runs, and print what it prints.

    Args:
        page: named in failures.
        script: the commands by their lines.
        directory: an empty one, for the copy of the checkout and the home directory.
        domain: ROS domain of everything that is started.

    Returns:
        The failures, each with the page and the line of the command.
    """
    checkout, home, file, printed = (
        directory / name for name in ("greenroof_ros", "home", "script", "printed")
    )
    home.mkdir()
    _copy_checkout(checkout)
    (directory / "functions").write_text(_FUNCTIONS, encoding="utf-8")
    lines = {1: f"page={page}; . ../functions", **script}
    file.write_text("".join(
        lines.get(number, "") + "\n" for number in range(1, max(lines) + 1)
    ), encoding="utf-8")
    environment = {
        **{name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        "PATH": f"{checkout}/.venv/bin:{os.environ['PATH']}", "HOME": str(home),
        "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "PYTHONUNBUFFERED": "1",
    }
    with printed.open("w") as stream:
        code = subprocess.run(
            ["bash", "-e", file], cwd=checkout, env=environment, stdin=subprocess.DEVNULL,
            stdout=stream, stderr=subprocess.STDOUT, start_new_session=True, check=False,
        ).returncode
    left = _left_running(home)
    output = printed.read_text(encoding="utf-8", errors="replace")
    print(output)
    begin, *commands = re.split(rf"@ (?={page}:\d+: )", output)
    failures = [
        f"{each.splitlines()[0]}: a traceback" for each in commands
        if "Traceback (most recent call last)" in each
    ]
    if code != 0:
        failures.append(f"{commands[-1] if commands else begin}exit code {code}")
    return [*failures, *(f"{page}:{max(lines)}: left running: {each}" for each in left)]


def _left_running(home: Path) -> list[str]:
    """Return the processes with a home directory that still run after some time; end them."""
    mark = f"HOME={home}".encode()
    until = time.monotonic() + 10
    while True:
        running = {}
        for entry in Path("/proc").glob("[0-9]*"):
            try:
                if mark in (entry / "environ").read_bytes().split(b"\0"):
                    words = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
                    running[int(entry.name)] = words
            except OSError:  # it has ended, or is another user's
                continue
        if not running or time.monotonic() > until:
            break
        time.sleep(0.2)
    for number in running:
        os.kill(number, signal.SIGKILL)
    return list(running.values())
