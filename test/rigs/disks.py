"""Disks for the tests: small ones that fill up, and one that hangs; and a pipe that is full."""

from __future__ import annotations

import fcntl
import os
import resource
import shutil
import struct
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest


@contextmanager
def disk_if_allowed(place: Path, size: str) -> Iterator[bool]:
    """Mount a disk of a size such as ``64k`` if that is permitted; return whether it was."""
    place.mkdir(parents=True, exist_ok=True)
    mounted = shutil.which("mount") is not None and not subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "greenroof_ros", str(place)],
        capture_output=True, check=False,
    ).returncode
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", str(place)], check=True)


@contextmanager
def small_disk(place: Path, size: str) -> Iterator[None]:
    """Mount a disk of a size such as ``64k``, or skip the test."""
    with disk_if_allowed(place, size) as mounted:
        if not mounted:
            pytest.skip("only root can mount a small disk")
        yield


@contextmanager
def _own_disk(place: Path) -> Iterator[Callable[[], None]]:
    """Mount an ext4 disk, and yield a function that mounts it again; or skip the test."""
    image = place.with_suffix(".image")
    with image.open("wb") as stream:
        stream.truncate(64_000_000)
    place.mkdir(parents=True, exist_ok=True)
    mount = ["mount", "-o", "loop,errors=remount-ro", str(image), str(place)]
    for words in (["mkfs.ext4", "-q", str(image)], mount):
        if shutil.which(words[0]) is None or subprocess.run(
            words, capture_output=True, check=False
        ).returncode:
            pytest.skip("only root can mount a disk of its own")

    def mount_again() -> None:
        subprocess.run(["umount", "--lazy", str(place)], check=True)
        subprocess.run(mount, check=True)

    try:
        yield mount_again
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)


# ioctl(2) of ext4: EXT4_IOC_SHUTDOWN, with the flag not to write its journal.
_SHUTDOWN, _NO_FLUSH = 0x8004587D, 2


@contextmanager
def disk_that_fails(place: Path) -> Iterator[Callable[[str], None]]:
    """Mount a disk, and yield a function that makes it fail; or skip the test.

    ``EIO``: no file can be read or written any more. ``EROFS``: the kernel has found an error, and
    nothing can be written any more. Otherwise it is mounted again, and good.
    """
    with _own_disk(place) as mount_again:

        def fail(how: str) -> None:
            if how == "EIO":
                disk = os.open(place, os.O_RDONLY)
                fcntl.ioctl(disk, _SHUTDOWN, struct.pack("I", _NO_FLUSH))
                os.close(disk)
            elif how == "EROFS":
                minor = os.minor(place.stat().st_dev)
                Path(f"/sys/fs/ext4/loop{minor}/trigger_fs_error").write_text("1")
            else:
                mount_again()

        yield fail


@contextmanager
def disk_that_hangs(place: Path) -> Iterator[Callable[[bool], None]]:
    """Mount a disk, and yield a function that makes it hang or go on; or skip the test.

    While it hangs, nothing can be written, and even kill -9 cannot end a process that tries to.
    """
    hangs = False

    def hang(now: bool) -> None:
        nonlocal hangs
        if now != hangs:
            option = "--freeze" if now else "--unfreeze"
            subprocess.run(["fsfreeze", option, str(place)], check=True)
        hangs = now

    with _own_disk(place):
        try:
            yield hang
        finally:
            hang(False)


def fill(file: Path) -> None:
    """Let a file grow until its disk is full to the last byte."""
    with file.open("wb", buffering=0) as stream:
        for size in (1 << 16, 1):
            with suppress(OSError):
                while True:
                    stream.write(bytes(size))


@contextmanager
def no_file_beyond(size: int) -> Iterator[None]:
    """Let no file of this process grow beyond a size (bytes)."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def full_pipe() -> Iterator[tuple[int, int]]:
    """Yield the read and the write end of a pipe that is full of zeros and takes nothing more."""
    reading, writing = os.pipe()
    try:
        os.set_blocking(writing, False)
        for size in (4096, 1):
            with suppress(BlockingIOError):
                while True:
                    os.write(writing, bytes(size))
        os.set_blocking(writing, True)
        yield reading, writing
    finally:
        os.close(reading)
        os.close(writing)


_BAD_DISK = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

ssize_t read(int file, void *buffer, size_t size) {
    ssize_t (*real)(int, void *, size_t) = dlsym(RTLD_NEXT, "read");
    off64_t at = lseek64(file, 0, SEEK_CUR);
    char link[64], name[4096] = "", *bad = getenv("BAD_SECTOR"), *cut = getenv("CUT_TO");
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    if (readlink(link, name, sizeof name - 1) < 0 || !strstr(name, "bag_0.mcap"))
        return real(file, buffer, size);
    if (cut && truncate(name, atol(cut)))
        return -1;
    if (bad && at < atol(bad) + 4096 && at + (off64_t) size > atol(bad)) {
        if (at < atol(bad))
            return real(file, buffer, atol(bad) - at);
        errno = EIO;
        return -1;
    }
    return real(file, buffer, size);
}
"""


def bad_disk(directory: Path) -> dict[str, str]:
    """Return the environment of a process for which a disk fails while it reads ``bag_0.mcap``.

    With BAD_SECTOR, 4096 bytes from there cannot be read; with CUT_TO, another process cuts the
    file to this length once reading has begun. The kernel's answers are as read(2) has them.
    """
    library = directory / "bad_disk.so"
    if shutil.which("cc") is None or subprocess.run(
        ["cc", "-shared", "-fPIC", "-x", "c", "-", "-o", library, "-ldl"], input=_BAD_DISK,
        text=True, check=False, stderr=subprocess.DEVNULL,
    ).returncode:
        pytest.skip("a failing disk needs a C compiler (gcc, libc6-dev)")
    return {"LD_PRELOAD": str(library)}
