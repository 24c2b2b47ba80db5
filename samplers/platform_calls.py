"""Platform calls: signals and limits, in one place for the systems that differ in them.

A function of this module looks for what the system offers when it is called, and does without where it can. No other
module of `samplers` imports `resource`, or calls what only POSIX has.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

DEFERRED_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


@contextmanager
def defer_signals() -> Iterator[None]:
    """Let SIGINT, SIGTERM and SIGHUP wait for the end of the block; the second one does not wait.

    Only those with a handler in Python, and in the main thread, as others do not interrupt Python code.

    Example:
        >>> import os, signal
        >>> before = signal.signal(signal.SIGINT, signal.default_int_handler)
        >>> try:
        ...     with defer_signals():
        ...         os.kill(os.getpid(), signal.SIGINT)
        ...         print("complete")
        ... except KeyboardInterrupt:
        ...     print("interrupted")
        complete
        interrupted
        >>> before = signal.signal(signal.SIGINT, before)
    """
    handlers: dict[int, Callable[[int, FrameType | None], Any]] = {}
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if len(received) > 1:
            handlers[number](number, frame)

    if threading.current_thread() is threading.main_thread():
        for number in DEFERRED_SIGNALS:
            handler = signal.getsignal(number)
            if callable(handler):
                handlers[number] = handler
                signal.signal(number, note)
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if len(received) == 1:
            handlers[received[0]](received[0], None)


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
