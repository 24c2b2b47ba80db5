"""What a core allows: the arithmetic of a call of torch, counted, over the rates at which the core does each kind.

The count is that of the torch core: each element of a result one operation, products of matrices by their sizes. A
core that skips some of it, the sine of a heading of 0, say, has less to do. Kinds are taken one after the other, and
each input as read and each result as written once, so that a share of the bound is good to some tenths.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import numba
import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.simulation.timing import seconds
from rare_envs.fast.networks import activate

SIMPLE = frozenset(
    "add sub rsub mul neg abs sign square relu lerp addcmul where masked_fill clamp clamp_min clamp_max minimum "
    "maximum round floor ceil trunc eq ne lt le gt ge isfinite isnan nan_to_num logical_and logical_or logical_not "
    "isneginf bitwise_and bitwise_or bitwise_not __and__ __or__ __lshift__ __rshift__".split()
)
"""Sums, products, comparisons, choices."""
REDUCTIONS = frozenset(
    "any all count_nonzero sum mean amin amax min max argmin argmax prod cumsum cummin cummax".split()
)
"""A simple operation for each element that they read."""
ROOTS = frozenset("div sqrt rsqrt reciprocal remainder fmod floor_divide hypot linalg_vector_norm".split())
CURVES = frozenset(
    "sin cos tan asin acos atan atan2 arctan2 sinh cosh tanh exp expm1 log log1p pow sigmoid softplus softmax "
    "special_log_ndtr special_ndtr".split()
)
PRODUCTS = {"mm": 0, "bmm": 0, "matmul": 0, "linear": 0, "addmm": 1, "baddbmm": 1}
"""Products of matrices, with the place of their first factor."""
MOVES = frozenset(
    "_local_scalar_dense _reshape_alias _to_copy _unsafe_view alias arange argsort as_strided broadcast_to cat "
    "clone contiguous copy copy_ detach detach_ diagonal embedding empty empty_like empty_strided expand expand_as "
    "eye fill_ flatten flip full full_like gather index index_copy_ index_put_ index_select is_nonzero item "
    "lift_fresh mT masked_select movedim new_empty new_full new_ones new_zeros nonzero nonzero_numpy normal_ "
    "numpy_T ones ones_like permute rand randn repeat reshape resolve_conj resolve_neg scalar_tensor scatter "
    "scatter_ scatter_reduce_ searchsorted select select_scatter slice slice_scatter sort split split_with_sizes "
    "squeeze stack t take_along_dim tensor_split to transpose unbind uniform_ unsqueeze view view_as zero_ zeros "
    "zeros_like".split()
)
"""What moves, makes or finds numbers: nothing of it need remain in a fused loop."""
CACHED = 1 << 14
"""Elements of arrays on which rates are measured: 64 KiB, within a core's own cache."""
SHORT, LONG = 500, 20
"""Repetitions of work that takes a tenth of a millisecond and some milliseconds: a machine that is shared stands still
for longer than a few of them take."""
MATRIX = 384
"""Rows and columns of the matrices likewise."""


class OperationCount(TorchDispatchMode):
    """Operations of what torch computes within it, by kind.

    Example:
        >>> with OperationCount() as count:
        ...     _ = torch.ones(10).sin() + 1.0
        ...     _ = torch.ones(4, 3) @ torch.ones(3, 5)
        >>> dict(count.operations)
        {'curves': 10, 'simple': 10, 'products': 120}
    """

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.operations: Counter[str] = Counter()

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        """Compute, and count.

        Raises:
            ValueError: It is not known what kind of operation this is.
        """
        out = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__
        kind = _find_kind(name)
        if kind == "products":
            self.operations[kind] += 2 * out.numel() * args[PRODUCTS[name]].shape[-1]
        elif kind is not None:
            self.operations[kind] += (args[0] if name in REDUCTIONS else out).numel()
        return out


def _find_kind(name: str) -> str | None:
    """Return the kind of an operation, of one in place too; None of a move."""
    if name in MOVES:
        return None
    kinds = {"simple": SIMPLE | REDUCTIONS, "roots": ROOTS, "curves": CURVES, "products": PRODUCTS.keys()}
    for kind, names in kinds.items():
        if name in names or name.removesuffix("_") in names:
            return kind
    raise ValueError(f"Expected an operation of a known kind, got {name!r}: put it into a list of {__name__}.")


def count_operations(work: Callable[[], object]) -> Counter[str]:
    """Return the operations of a piece of work by kind."""
    with OperationCount() as count:
        work()
    return count.operations


def measure_machine() -> dict[str, float]:
    """Return operations a second of one core by kind, in single precision, and bytes a second of its memory.

    A function such as the sine counts as a hyperbolic tangent, the fastest that is at hand: a quotient of polynomials.
    """
    matrix, product = torch.rand(MATRIX, MATRIX), torch.empty(MATRIX, MATRIX)
    large = np.zeros(1 << 24, np.float32)  # 64 MiB, in no cache
    numbers = np.full(CACHED, 0.7, np.float32)
    for work in (lambda: _polynomials(numbers, 1), lambda: _quotients(numbers, 1), lambda: activate(numbers, True)):
        work()  # compiles
    return {
        "simple": 17 * 100 * CACHED / seconds(lambda: _polynomials(numbers, 100), SHORT),
        "roots": 100 * CACHED / seconds(lambda: _quotients(numbers, 100), SHORT),
        "curves": 100 * CACHED / seconds(lambda: [activate(numbers, True) for _ in range(100)], SHORT),
        "products": 2
        * MATRIX**3
        * 10
        / seconds(lambda: [torch.mm(matrix, matrix, out=product) for _ in range(10)], LONG),
        "bytes": 2 * large.nbytes / seconds(large.copy, LONG),
    }


@numba.njit(fastmath=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _polynomials(numbers: Any, times: int) -> None:
    """Evaluate a polynomial of degree 8 everywhere: 17 simple operations."""
    for _ in range(times):
        for place in range(len(numbers)):
            x = numbers[place]
            total = x
            for _ in range(8):
                total = total * x + np.float32(0.1)
            numbers[place] = total * np.float32(0.5)


@numba.njit(fastmath=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _quotients(numbers: Any, times: int) -> None:
    for _ in range(times):
        for place in range(len(numbers)):
            numbers[place] = np.float32(0.7) / numbers[place]


def bound_seconds(operations: Mapping[str, int], machine: Mapping[str, float], n_bytes: float = 0.0) -> float:
    """Return the least time [s] of a piece of work on one core: that of its arithmetic or of its memory.

    Args:
        operations: By kind, of `count_operations`.
        machine: Rates of `measure_machine`.
        n_bytes: What must be read and written.

    Example:
        >>> bound_seconds({"simple": 250, "curves": 25}, {"simple": 1e3, "curves": 1e2, "bytes": 1e2}, n_bytes=8)
        0.5
    """
    arithmetic = sum(number / machine[kind] for kind, number in operations.items())
    return max(arithmetic, n_bytes / machine["bytes"])


def bound_rate(simulate: Callable[[Any], Any], x: Any, machine: Mapping[str, float]) -> float:
    """Return rollouts a second that a core allows: x of shape (rows, dim) are read, and f of each row is written.

    Args:
        simulate: A call of torch with the rows.
        x: Rows, in double precision.
        machine: Rates of `measure_machine`.
    """
    operations = count_operations(lambda: simulate(x))
    return len(x) / bound_seconds(operations, machine, n_bytes=x.nbytes + 8.0 * len(x))
