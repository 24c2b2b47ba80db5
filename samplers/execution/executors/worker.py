"""Worker: the program of a process that computes chunks for a driver, and ends with it.

Requests come on standard input and results go to standard output, as pickles; what foreign code prints goes to
standard error.
"""

from __future__ import annotations

import os
import pickle
import queue
import signal
import sys
import threading
from typing import IO, Any, NamedTuple

from samplers.execution.executors.base import ExecutorError
from samplers.execution.executors.chunks import Chunk, Index, Packed
from samplers.system import limit_memory


class Reply(NamedTuple):
    """What comes back for a chunk."""

    result: Packed | None
    """The result."""
    error: BaseException | None = None
    """What the work raised instead."""
    call: int = 0
    """Number of the call that it answers, where calls are numbered."""


def main() -> None:
    """Compute chunks until standard input is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the driver decides
    import cloudpickle  # only workers need it

    inbox, outbox = _take_streams()
    packed, memory = pickle.load(inbox)
    try:
        compute = cloudpickle.loads(packed)
    except BaseException as error:
        _send(outbox, Reply(None, ExecutorError(f"A worker process cannot load the problem ({describe(error)}).")))
        return
    limit_memory(memory)
    _send(outbox, Reply(None))  # ready
    requests: queue.SimpleQueue[tuple[Index, Chunk]] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(inbox, requests), daemon=True).start()
    while True:
        index, chunk = requests.get()
        _send(outbox, reply_to(compute, index, chunk))


def reply_to(compute: Any, index: Index, chunk: Chunk) -> Reply:
    """Compute a chunk; an ego that exits takes the process with it, as one that crashes does.

    Raises:
        SystemExit: The work exits.
    """
    try:
        return Reply(compute(index, chunk))
    except SystemExit:
        raise
    except BaseException as error:
        return Reply(None, make_portable(error))


def make_portable(error: BaseException) -> BaseException:
    """Return an error that can be sent: itself if it survives that, else its words.

    Example:
        >>> make_portable(ArithmeticError("off the map"))
        ArithmeticError('off the map')
    """
    try:
        if str(pickle.loads(pickle.dumps(error))) == str(error):
            return error
    except Exception:  # its class is the user's: anything may happen in it
        pass
    return RuntimeError(describe(error))


def describe(error: BaseException) -> str:
    """Return the type and the text of an error."""
    return f"{type(error).__name__}: {error}".removesuffix(": ")


def _take_streams() -> tuple[IO[bytes], IO[bytes]]:
    """Return standard input and output for the driver alone; others read nothing and print to standard error."""
    inbox, outbox = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.dup2(2, 1)
    return inbox, outbox


def _read(inbox: IO[bytes], requests: queue.SimpleQueue[tuple[Index, Chunk]]) -> None:
    """Pass on requests; end the process when the driver is gone, also in the midst of a computation."""
    try:
        while True:
            requests.put(pickle.load(inbox))
    except (EOFError, OSError, pickle.UnpicklingError):
        os._exit(0)
    except BaseException as error:  # such as no memory: without this thread the process would wait for ever
        print(f"A request cannot be read: {describe(error)}", file=sys.stderr, flush=True)
        os._exit(1)


def _send(outbox: IO[bytes], reply: Reply) -> None:
    pickle.dump(reply, outbox, protocol=pickle.HIGHEST_PROTOCOL)
    outbox.flush()
