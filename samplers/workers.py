"""Workers: how a chunk of a request is computed, here or in another process, and which of its rows fail."""

from __future__ import annotations

import faulthandler
import math
import os
import pickle
import random
import re
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from samplers.method import Request
from samplers.problem import EvaluationError, FloatArray, OnError, describe_point, one_per_row

PARENT_SECONDS = 1.0
"""Time [s] between two looks of a worker whether its driver is still there."""
NAN_REASON = "f is NaN"

Index = tuple[int, ...]
"""Number of a chunk in its run; of a row computed by itself, also its number in the chunk. It keys random draws."""


class WorkerLost(Exception):
    """A worker ended, or did not answer in time: perhaps because of a row of its chunk, perhaps not."""


class ExecutorError(RuntimeError):
    """An executor cannot work at all; calling it again would not help.

    Example:
        An executor of your own raises it where waiting and trying again are of no use.

        >>> from samplers import ExecutorError
        >>> ExecutorError("The queue of the cluster is closed.").final
        True
    """

    final = True


class Result(NamedTuple):
    """What a chunk gives."""

    table: FloatArray
    """A row for each row of the chunk, (n, k): f; f, values and ticks of terms; or a gradient. NaN where there is none;
    k = 1 where no row has any."""
    notes: dict[str, Any]
    """What else is known, JSON-ready: `reasons` of rows without f, in their order (in an attempt: by row), `n_retried`,
    `lost`, `seconds`, `cost` of gradients, `threshold` and `names` of terms."""


def widen_table(table: FloatArray, width: int) -> FloatArray:
    """Return a table (n, k) with `width` columns; what it does not know is NaN."""
    if table.shape[1] == width:
        return table
    return np.pad(table, ((0, 0), (0, width - table.shape[1])), constant_values=np.nan)


def join_results(parts: Sequence[Result]) -> Result:
    """Return the results of parts as one: numbers in notes are added, lists joined, the rest is that of the first."""
    notes: dict[str, Any] = {}
    for name, value in (item for part in parts for item in part.notes.items()):
        adds = name in notes and name not in ("names", "threshold") and isinstance(value, int | float | list)
        notes[name] = notes[name] + value if adds else notes.get(name, value)
    width = max(part.table.shape[1] for part in parts)
    return Result(np.concatenate([widen_table(part.table, width) for part in parts]), notes)


# Rows that fail


def isolate(attempt: Callable[[Request], Result], chunk: Request, fail: Callable[..., None]) -> Result:
    """Return what the rows of a chunk give, those that fail left out; notes have their `reasons` as a dict by row.

    Where an attempt raises, its parts are attempted (`split_rows`), until the rows that raise stand alone. A row that
    has given nothing is attempted once more; if that gives nothing either, `fail(row, reason, error)` is told, which
    may raise.
    """
    n_retried, lost, found = 0, dict[int, str](), list[tuple[NDArray[np.int64], Result]]()

    def settle(rows: NDArray[np.int64], again: bool) -> None:
        nonlocal n_retried
        n_retried += len(rows) if again else 0
        try:
            found.append((rows, attempt(chunk if len(rows) == len(chunk) else chunk.take(rows))))
            return
        except (Exception, SystemExit) as error:  # the simulation is the user's: anything may happen in it
            met: BaseException = error
        if getattr(met, "final", False):  # calling f again cannot help
            raise met
        if again and len(rows) == 1:
            lost[int(rows[0])] = reason_of(met)
            fail(int(rows[0]), lost[int(rows[0])], met)
            found.append((rows, Result(np.full((1, 1), np.nan), {})))
        else:
            for part in split_rows(rows, met, len(chunk)):
                settle(part, True)

    settle(np.arange(len(chunk)), False)
    unsure = {int(rows[at]): why for rows, each in found for at, why in each.notes.get("reasons", {}).items()}
    if unsure:
        settle(np.array(sorted(unsure)), True)
    whole = join_results([each for _, each in found])
    table = np.empty((len(chunk), whole.table.shape[1]))
    table[np.concatenate([rows for rows, _ in found])] = whole.table  # what came last stands
    again_failed = {row: why for row, why in unsure.items() if np.isnan(table[row, 0])}
    for row in sorted(set(again_failed) - set(lost)):
        fail(row, again_failed[row])
    return Result(table, {**whole.notes, "reasons": {**again_failed, **lost}, "n_retried": n_retried})


def split_rows(rows: NDArray[np.int64], error: BaseException, whole: int) -> list[NDArray[np.int64]]:
    """Return the parts in which rows are attempted after an error.

    Halves take the fewest attempts. Where the error means that an answer was waited for (its attribute `waits`),
    attempts are cheaper than errors: then parts of about the root of the whole chunk, and after that each row alone.
    """
    if not getattr(error, "waits", False):
        return np.array_split(rows, min(2, len(rows)))
    root = math.isqrt(whole)
    size = root if 1 < root < len(rows) else 1
    return np.split(rows, range(size, len(rows), size))


def reason_of(error: BaseException) -> str:
    """Return what went wrong, in one line."""
    words = " ".join(str(error).split())
    if isinstance(error, ValueError) and words:  # most say what is wrong by themselves
        return words
    return f"{type(error).__name__}: {words}" if words and not isinstance(error, SystemExit) else repr(error)


# What a chunk is computed by


@dataclass(frozen=True)
class Work:
    """Computes a chunk, here or in a worker, by `evaluate`, `terms` or `gradient` of a problem.

    A problem that goes on by itself with the rows on which it does not fail has `attempt(x)` and `attempt_terms(x,
    gamma)`, which also give the reasons by row. A row that fails ends the run where on_error is "raise"; else its f and
    terms are NaN. `name` is that of f in messages. With a seed, what simulations draw follows from it and the index of
    their chunk (`seed_generators`).
    """

    problem: Any
    gamma: float
    on_error: OnError
    name: str = "f"
    seed: int | None = None

    def __call__(self, chunk: Request, index: Index = ()) -> Result:
        """Compute a chunk; raise an EvaluationError for a row that fails ("raise") and for results of a wrong form."""
        if self.seed is None:
            return self._compute(chunk)
        torch_is_new = "torch" not in sys.modules
        with seed_generators(self.seed, index):
            result = self._compute(chunk)
        if torch_is_new and "torch" in sys.modules:  # its generator was not seeded
            with seed_generators(self.seed, index):
                return self._compute(chunk)
        return result

    def _compute(self, chunk: Request) -> Result:
        start = time.perf_counter()
        with np.errstate():  # a problem that sets NumPy's errors sets them for itself
            found = isolate(partial(_attempt, self.problem, self.gamma), chunk, partial(self._refuse, chunk))
        notes = dict(found.notes)
        reasons = notes.pop("reasons")
        if chunk.kind == "gradient":
            notes["cost"] = notes.get("cost", 0.0) + float(self.problem.gradient_cost) * len(reasons)
        else:
            notes["reasons"] = [reasons[row] for row in sorted(reasons)]
        return Result(found.table, {**notes, "seconds": time.perf_counter() - start})

    def lose(self, chunk: Request, reason: str) -> Result:
        """Return the result of a row that no worker survives; an EvaluationError where on_error is "raise"."""
        self._refuse(chunk, 0, reason)
        about = {"cost": float(self.problem.gradient_cost)} if chunk.kind == "gradient" else {"reasons": [reason]}
        return Result(np.full((1, 1), np.nan), {"n_retried": 0, "lost": [reason], **about})

    def _refuse(self, chunk: Request, row: int, reason: str, cause: BaseException | None = None) -> None:
        """Raise an EvaluationError for a row of a chunk that has failed for good, if on_error is "raise"."""
        if self.on_error == "raise":
            what = "The gradient" if chunk.kind == "gradient" else self.name
            raise EvaluationError(
                f'{what} failed twice on x = {describe_point(chunk.x[row])}: {reason}; on_error "failure" or "bound" '
                "would count it instead."
            ) from cause


def _attempt(problem: Any, gamma: float, chunk: Request) -> Result:
    """Return what a problem gives for a chunk, with the reasons by row where it gives nothing; it may write on x."""
    x, *about = (array.copy() for array in chunk.arrays)
    n, notes, reasons = len(x), dict[str, Any](), dict[int, str]()
    if chunk.kind == "gradient":
        found = problem.gradient(x, *about, gamma)
        table = np.asarray(found.values, dtype=np.float64)
        if table.shape != x.shape:
            raise EvaluationError(f"Expected gradients of shape {x.shape}, got {table.shape}.")
        return Result(table, {"cost": float(found.cost), "reasons": {}})
    whole, by_row, more = ("terms", "attempt_terms", (gamma,)) if chunk.kind == "terms" else ("evaluate", "attempt", ())
    if _have_same_owner(problem, whole, by_row):
        found, reasons = getattr(problem, by_row)(x, *more)  # foreign methods, by name
    else:
        found = getattr(problem, whole)(x, *more)
    if chunk.kind == "f":
        f = one_per_row(found, n)
        table = f[:, None]
    else:
        f, values, ticks = one_per_row(found.f, n), np.asarray(found.values, float), np.asarray(found.ticks)
        if values.ndim != 2 or len(values) != n or values.shape[1] == 0 or ticks.shape != values.shape:
            raise EvaluationError(f"Expected values and ticks of shape ({n}, J), got {values.shape} and {ticks.shape}.")
        f = np.where(np.isnan(values).any(axis=1), np.nan, f)
        table = np.column_stack((f, values, ticks))
        notes = {"threshold": float(found.threshold), "names": list(getattr(found, "names", ()))}
    reasons = dict.fromkeys(np.flatnonzero(np.isnan(f)).tolist(), NAN_REASON) | reasons
    return Result(table, {**notes, "reasons": reasons})


def _have_same_owner(problem: Any, whole: str, by_row: str) -> bool:
    """Return whether the method that goes on with the other rows computes what the method `whole` does.

    A subclass, a wrapper or an instance that has `whole` of its own is asked by that.
    """
    owner = getattr(getattr(problem, by_row, None), "__self__", None)
    if owner is None or getattr(getattr(problem, whole, None), "__self__", None) is not owner:
        return False
    definition = next(vars(kind) for kind in type(owner).__mro__ if {whole, by_row} & set(vars(kind)))
    return {whole, by_row} <= set(definition)


@contextmanager
def seed_generators(seed: int, index: Index) -> Iterator[None]:
    """Let the global generators begin anew for the length of a block, by the seed of the run and a chunk's index.

    A simulation is to draw nothing itself. One that does (a policy that samples its actions) draws the same again when
    its chunk is computed again, on whichever worker, as long as it uses the generators of `random`, `numpy.random` or,
    on the CPU, torch.
    """
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


# In a worker process


class ProcessName(NamedTuple):
    """A process among those of all machines: numbers of processes repeat from one machine to the next."""

    program: str
    number: int


class Limits(NamedTuple):
    """What a chunk may take of a worker process: time [s], after which that ends itself, and memory [bytes]."""

    seconds: float | None = None
    n_bytes: float | None = None


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


def name_process() -> ProcessName:
    """Return the name of this process."""
    return ProcessName(_PROGRAM, os.getpid())


def compute_in_worker(
    key: str, packed: bytes, driver: ProcessName, limits: Limits, index: Index, chunk: Request, call: int
) -> Reply:
    """Compute a chunk in a worker of any kind; the driver, which may be one, is neither ended nor limited."""
    try:
        work = _load(key, packed, driver, limits)
    except BaseException as error:
        words = f"A worker process cannot load the problem ({describe(error)})."
        return Reply(ExecutorError(words), call)
    seconds = None if name_process() == driver else limits.seconds
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


def _load(key: str, packed: bytes, driver: ProcessName, limits: Limits) -> Work:
    """Return the work, and limit the process when it is new."""
    if key not in _loaded:
        import cloudpickle  # only workers need it

        _loaded[key] = cloudpickle.loads(packed)
        while len(_loaded) > 2:
            _loaded.popitem(last=False)
        if name_process() != driver:
            end_with(driver.number)
            limit_memory(limits.n_bytes)
    return _loaded[key]


def end_with(driver: int) -> None:
    """Let this process end with the driver that is its parent: the workers of most pools would wait for it for ever."""

    def watch() -> None:
        while os.getppid() == driver:
            time.sleep(PARENT_SECONDS)
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
    if limit is not None and seconds >= limit:
        return f"no answer within {limit:g} s"
    if ended is not None:
        return f"the process of the simulation ended with exit code {ended[2]}"
    return describe(error).split("\n", 1)[0]
