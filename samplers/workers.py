"""Workers: how a chunk of a request is computed in another process, and what is said of one that is lost."""

import faulthandler
import os
import pickle
import re
import threading
import time
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple
from uuid import uuid4

from samplers.evaluate import Index, Result, Work
from samplers.method import Request

SAFE_PATH = "PYTHONSAFEPATH"
"""Variable by which Python leaves the working directory out."""


class WorkerLost(Exception):
    """A worker ended, or did not answer in time: perhaps because of a row of its chunk, perhaps not."""


class ExecutorError(RuntimeError):
    """An executor cannot work at all; calling it again would not help.

    Example:
        An executor of your own raises it where waiting and trying again are of no use.

        >>> from samplers.executors import ExecutorError
        >>> ExecutorError("The queue of the cluster is closed.").final
        True
    """

    final = True


class Reply(NamedTuple):
    """What a worker has found for a chunk, or raised; `call` is the number of the call.

    Dask takes a call with the arguments of an earlier one for that one, and would answer that its worker died.
    """

    found: Result | BaseException
    call: int


_PROGRAM = uuid4().hex
_WATCH = "watches the driver"
_loaded: OrderedDict[str, Work] = OrderedDict()
"""Work of this process by its digest."""


def name_process() -> tuple[str, int]:
    """Return the name of this process: numbers of processes repeat from one machine to the next."""
    return _PROGRAM, os.getpid()


@contextmanager
def starting_processes() -> Iterator[None]:
    """Let a Python that is started meanwhile not look for modules in the working directory first (from 3.11 on).

    The folder may be somebody else's. The process is to remove the variable: what an ego starts finds its own as ever.
    """
    before = os.environ.get(SAFE_PATH)
    os.environ[SAFE_PATH] = before or "1"
    try:
        yield
    finally:
        if not before:
            del os.environ[SAFE_PATH]


def compute_in_worker(
    key: str,
    packed: bytes,
    driver: tuple[str, int],
    limits: tuple[float | None, float | None],
    index: Index,
    chunk: Request,
    call: int,
) -> Reply:
    """Compute a chunk in a worker of any kind; the driver, which may be one, is neither ended nor limited.

    The limits are the time of a chunk [s], after which the process ends itself, and memory [bytes].
    """
    try:
        work = _load(key, packed, driver, limits[1])
    except BaseException as error:
        words = f"A worker process cannot load the problem ({describe(error)})."
        return Reply(ExecutorError(words), call)
    seconds = None if name_process() == driver else limits[0]
    with open(os.devnull, "w", encoding="utf-8") as nothing:
        if seconds is not None:
            faulthandler.dump_traceback_later(seconds, exit=True, file=nothing)
        try:
            return Reply(work(chunk, index), call)
        except BaseException as error:
            return Reply(make_portable(error), call)
        finally:
            if seconds is not None:
                faulthandler.cancel_dump_traceback_later()


def _load(key: str, packed: bytes, driver: tuple[str, int], memory_limit: float | None) -> Work:
    """Return the work, and limit the process when it is new."""
    if key not in _loaded:
        import cloudpickle  # only workers need it

        _loaded[key] = cloudpickle.loads(packed)
        while len(_loaded) > 2:
            _loaded.popitem(last=False)
        if name_process() != driver:
            end_with(driver[1])
            limit_memory(memory_limit)
    return _loaded[key]


def end_with(driver: int) -> None:
    """Let this process end with the driver that is its parent: the workers of most pools would wait for it for ever."""

    def watch() -> None:
        while os.getppid() == driver:
            time.sleep(1.0)
        os._exit(1)

    if os.getppid() == driver and not any(thread.name == _WATCH for thread in threading.enumerate()):
        threading.Thread(target=watch, name=_WATCH, daemon=True).start()


def limit_memory(n_bytes: float | None) -> None:
    """Let this process have so many bytes more than it has, where the system can limit data (Linux)."""
    if n_bytes is None or not os.path.exists("/proc/self/statm"):  # macOS, Windows
        return
    import resource

    with open("/proc/self/statm", encoding="ascii") as file:
        data = int(file.read().split()[5]) * resource.getpagesize()
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]  # which only root may raise
    soft = data + int(n_bytes) if hard == resource.RLIM_INFINITY else min(data + int(n_bytes), hard)
    resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def pack(work: Work) -> bytes:
    """Return work as bytes; functions of a script or a notebook, closures and lambdas go with it."""
    import cloudpickle

    try:
        packed: bytes = cloudpickle.dumps(work)
    except Exception as error:  # the problem is the user's: anything may happen in it
        raise ValueError(
            f"The problem cannot be sent to other processes ({type(error).__name__}: {error}); let f make in its first "
            "call what cannot be sent."
        ) from error
    return packed


def make_portable(error: BaseException) -> BaseException:
    """Return an error that can be sent: itself if it survives that, else its words."""
    try:
        if str(pickle.loads(pickle.dumps(error))) == str(error):
            return error
    except Exception:  # its class is the user's: anything may happen in it
        pass
    return RuntimeError(describe(error))


def describe(error: BaseException) -> str:
    """Return the type and the text of an error."""
    return f"{type(error).__name__}: {error}".removesuffix(": ")


def describe_loss(error: BaseException, seconds: float, limit: float | None) -> str:
    """Return why a worker was lost `seconds` after its chunk was submitted; loky knows how its process ended."""
    ended = re.search(r"exit codes of the workers are \{(?:EXIT|(\w+))\((-?\d+)\)", str(error))
    if ended is not None and ended[1]:
        return f"the process of the simulation was ended by {ended[1]}"
    # as `faulthandler.dump_traceback_later` ends it
    if limit is not None and seconds >= limit and (ended is None or ended[2] == "1"):
        return f"no answer within {limit:g} s"
    if ended is not None:
        return f"the process of the simulation ended with exit code {ended[2]}"
    return describe(error).split("\n", 1)[0]
