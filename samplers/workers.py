"""Workers: what computes chunks in another process, whoever has started that, and random generators of a chunk."""

from __future__ import annotations

import faulthandler
import os
import pickle
import random
import re
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple
from uuid import uuid4

import numpy as np

from samplers.chunks import Chunk, Index, Result
from samplers.dispatch import Compute, ExecutorError, Limits
from samplers.platform_calls import limit_memory

PARENT_SECONDS = 1.0
"""Time [s] between two looks of a worker whether its driver is still there."""


class ProcessName(NamedTuple):
    """A process among those of all machines: numbers of processes repeat from one machine to the next."""

    program: str
    number: int


class Reply(NamedTuple):
    """What comes back for a chunk."""

    result: Result | None
    error: BaseException | None
    call: int
    """Number of the call that it answers: dask takes a call with the arguments of an earlier one for that one, and
    would answer that its worker died."""


_PROGRAM = uuid4().hex
_WATCH = "watches the driver"
_loaded: OrderedDict[str, Compute] = OrderedDict()
"""Work of this process by its digest."""


def name_process() -> ProcessName:
    """Return the name of this process."""
    return ProcessName(_PROGRAM, os.getpid())


def compute_in_worker(
    key: str, packed: bytes, driver: ProcessName, limits: Limits, index: Index, chunk: Chunk, call: int
) -> Reply:
    """Compute a chunk in a worker of any kind; the driver, which may be one, is neither ended nor limited."""
    in_driver = name_process() == driver
    try:
        compute = _load(key, packed, driver, limits)
    except BaseException as error:
        words = f"A worker process cannot load the problem ({describe(error)})."
        return Reply(None, ExecutorError(words), call)
    seconds = None if in_driver else limits.seconds
    with open(os.devnull, "w", encoding="utf-8") as nothing:
        if seconds is not None:
            faulthandler.dump_traceback_later(seconds, exit=True, file=nothing)
        try:
            return Reply(compute(index, chunk), None, call)
        except BaseException as error:
            return Reply(None, make_portable(error), call)
        finally:
            if seconds is not None:
                faulthandler.cancel_dump_traceback_later()


def _load(key: str, packed: bytes, driver: ProcessName, limits: Limits) -> Compute:
    """Return the work, and limit the process when it is new."""
    if key not in _loaded:
        import cloudpickle  # only workers need it

        _loaded[key] = cloudpickle.loads(packed)
        while len(_loaded) > 2:
            _loaded.popitem(last=False)
        if name_process() != driver:
            end_with(driver.number)
            limit_memory(None if limits.n_bytes is None else int(limits.n_bytes))
    return _loaded[key]


def end_with(driver: int) -> None:
    """Let this process end with the driver that is its parent: the workers of most pools would wait for it for ever."""

    def watch() -> None:
        while os.getppid() == driver:
            time.sleep(PARENT_SECONDS)
        os._exit(1)

    if os.getppid() == driver and not any(thread.name == _WATCH for thread in threading.enumerate()):
        threading.Thread(target=watch, name=_WATCH, daemon=True).start()


def pack(work: Any) -> bytes:
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
    if limit is not None and seconds >= limit:
        return f"no answer within {limit:g} s"
    if ended is not None:
        return f"the process of the simulation ended with exit code {ended[2]}"
    return describe(error).split("\n", 1)[0]


@dataclass(frozen=True)
class SeededWork:
    """Work with the global random generators of its chunk, keyed by the seed of the run and the index of the chunk.

    A simulation is to draw nothing itself. One that does (a policy that samples its actions) draws the same again when
    its chunk is computed again, on whichever worker, as long as it uses the generators of `random`, `numpy.random` or,
    on the CPU, torch.
    """

    work: Callable[[Chunk], Result]
    seed: int

    def __call__(self, index: Index, chunk: Chunk) -> Result:
        """Compute a chunk; the generators are then as before.

        A chunk that imports torch, and draws by its generator before that could be seeded, is computed once more.
        """
        torch_is_new = "torch" not in sys.modules
        with seed_generators(self.seed, index):
            result = self.work(chunk)
        if not (torch_is_new and _torch_has_drawn()):
            return result
        with seed_generators(self.seed, index):
            return self.work(chunk)


def _torch_has_drawn() -> bool:
    """Return whether torch's generator, which begins in each process with a seed of its own, has left its beginning."""
    torch: Any = sys.modules.get("torch")
    if torch is None:
        return False
    fresh = torch.Generator().manual_seed(torch.initial_seed())
    return not torch.equal(fresh.get_state(), torch.random.get_rng_state())


@contextmanager
def seed_generators(seed: int, index: Index) -> Iterator[None]:
    """Let the global generators begin anew for the length of a block."""
    state = int(np.random.SeedSequence(seed, spawn_key=index).generate_state(1)[0])
    torch: Any = sys.modules.get("torch")  # not imported for this
    before = random.getstate(), np.random.get_state(), None if torch is None else torch.random.get_rng_state()  # noqa: NPY002
    random.seed(state)
    np.random.seed(state)  # noqa: NPY002  (the global generator, which foreign code uses)
    if torch is not None:
        torch.random.default_generator.manual_seed(state)
    try:
        yield
    finally:
        random.setstate(before[0])
        np.random.set_state(before[1])  # noqa: NPY002
        if torch is not None:
            torch.random.set_rng_state(before[2])
