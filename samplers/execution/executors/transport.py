"""Transport: work as bytes for other processes."""

from __future__ import annotations

from typing import Any


def pack_work(work: Any) -> bytes:
    """Return work as bytes; functions of a script or a notebook, closures and lambdas go with it.

    Raises:
        ValueError: Something in it cannot be sent.

    Example:
        >>> import threading
        >>> pack_work(threading.Lock())
        Traceback (most recent call last):
            ...
        ValueError: The problem cannot be sent to other processes (TypeError: cannot pickle '_thread.lock' object); let f make in its first call what cannot be sent.
    """  # noqa: E501 (the example shows a whole message)
    import cloudpickle

    try:
        packed: bytes = cloudpickle.dumps(work)
    except Exception as error:  # the problem is the user's: anything may happen in it
        raise ValueError(
            f"The problem cannot be sent to other processes ({type(error).__name__}: {error}); let f make in its first "
            "call what cannot be sent."
        ) from error
    return packed
