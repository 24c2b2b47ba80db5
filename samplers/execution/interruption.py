"""Interruption: what a run knows when it is interrupted, and signals that wait until a step is complete."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from samplers.result import Estimate

DEFERRED_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class EstimationInterrupted(KeyboardInterrupt):
    """An estimation was interrupted (Ctrl-C); it knows what the simulations made so far say.

    Example:
        >>> import samplers
        >>> calls = []
        >>> def f(x):
        ...     calls.append(len(x))
        ...     if len(calls) == 3:
        ...         raise KeyboardInterrupt  # as Ctrl-C does
        ...     return 2.0 - x[:, 0]
        >>> try:
        ...     result = samplers.estimate(samplers.FunctionProblem(f, 2), "mc", seed=0)
        ... except samplers.EstimationInterrupted as stopped:
        ...     result = stopped.estimate
        >>> result.n_sim, round(result.p, 4), str(result.status)
        (20000, 0.0228, 'stopped')
    """

    def __init__(self, estimate: Estimate) -> None:
        self.estimate = estimate
        """The estimate from the simulations made so far."""
        super().__init__(f"Interrupted after {estimate.n_sim:,} simulations; the estimate so far (`.estimate`):")
        self.args = (f"{self.args[0]}\n{estimate}",)


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
