"""Platform calls: locks, ends of processes, limits and folders, in one place for the systems that differ in them.

A function of this module looks for what the system offers when it is called, and does without where it can. No other
module of `samplers` imports `fcntl`, `resource` or `msvcrt`, or calls what only POSIX has.
"""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

BEYOND = 1 << 40
"""Position of the byte that is locked on Windows: beyond the content (1 TiB), which others may then still read."""


def lock_file(file: IO[bytes]) -> bool:
    """Lock an open file for this process until it is closed; return False if another process has it.

    The system lets go of the lock when the process ends, however. File systems that know no locks (some network
    drives) grant every lock.
    """
    try:
        import fcntl
    except ImportError:
        return _lock_byte(file)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # no locks here
        return True
    return True


def _lock_byte(file: IO[bytes]) -> bool:
    """Do what `lock_file` does on Windows."""
    msvcrt: Any = importlib.import_module("msvcrt")
    file.seek(BEYOND)
    try:
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    except OSError:
        return False
    return True


def end_process(child: subprocess.Popen[bytes]) -> None:
    """End a process at once, and what it has started where it leads a group of processes."""
    with suppress(OSError):
        if child.returncode is not None:  # its number may be that of another process by now
            return
        if hasattr(os, "killpg"):
            os.killpg(child.pid, signal.SIGKILL)
        else:
            child.kill()


def limit_memory(n_bytes: int | None) -> None:
    """Let this process have so many bytes more than now, where the system can limit data (Linux)."""
    if n_bytes is None:
        return
    try:
        import resource
    except ImportError:  # Windows
        return
    if not os.path.exists("/proc/self/statm"):  # macOS
        return
    with open("/proc/self/statm", encoding="ascii") as file:
        data = int(file.read().split()[5]) * resource.getpagesize()
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]  # which only root may raise
    soft = data + n_bytes if hard == resource.RLIM_INFINITY else min(data + n_bytes, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def sync_folder(folder: Path) -> None:
    """Return when the name of a new file is on the disk, where folders can be opened."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except PermissionError:  # Windows opens no folder
        return
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
