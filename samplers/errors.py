"""Errors: what is wrong with values that f returned, rules for rows on which it fails, libraries that are missing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, Protocol, get_args, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

OnError = Literal["raise", "failure", "bound"]
"""Rows on which f raises or gives NaN: stop, count the row as failing, or count it so in p and the upper end only."""
ON_ERROR: tuple[str, ...] = get_args(OnError)


@runtime_checkable
class FinalError(Protocol):
    """An exception with an attribute `final`: True if calling f again cannot help."""

    final: bool
    """Whether f has been called again already, or cannot return a value at all."""


class EvaluationError(ValueError):
    """f raised, returned NaN or returned something that is not one number per row.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: x, dim=2)
        >>> samplers.estimate(problem, "mc", seed=0, max_sim=100)
        Traceback (most recent call last):
            ...
        samplers.errors.EvaluationError: Expected f to return shape (100,), one value per row of x, got (100, 2). f gets a batch of points of shape (n, 2); pass vectorized=False for an f of one point.
    """  # noqa: E501 (the example shows a whole message)

    final = True


def one_per_row(outcomes: ArrayLike, n: int) -> NDArray[np.float64]:
    """Return the outcomes as float64, shape (n,).

    Called wherever outcomes of foreign code come in, each of which can be used without the others: a function
    (`FunctionProblem.evaluate`), outcomes told by the user (`Run.tell`), and the halves of a batch that raises, whose
    lengths must be right before they are joined (`samplers.chunks.isolate`).

    Raises:
        EvaluationError: If they are not n real numbers.
    """
    if outcomes is None:
        raise EvaluationError(
            f"Expected f to return shape ({n},), one value per row of x, got None: f has no `return`."
        )
    try:
        if np.iscomplexobj(outcomes):
            raise TypeError("complex numbers have no order")
        f = np.asarray(outcomes, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise EvaluationError(
            f"Expected f to return shape ({n},), one number per row of x: {str(error).rstrip('.')}."
        ) from error
    if f.shape != (n,):
        raise EvaluationError(f"Expected f to return shape ({n},), one value per row of x, got {f.shape}.")
    return f


def describe_point(x: NDArray[np.float64]) -> str:
    """Return a point x (d,) in one line."""
    return np.array2string(x, precision=6, threshold=8, separator=", ", max_line_width=10**6)


@contextmanager
def needs_library(library: str, purpose: str) -> Iterator[None]:
    """Raise an error that says what to install if an import in the block fails because a library is missing.

    Raises:
        ImportError: If the library, or a part of it, cannot be found.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != library:
            raise
        raise ImportError(f"{purpose} needs {library}: pip install {library}.", name=library) from None
