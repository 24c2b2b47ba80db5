"""What f returns, checked: one number for each row of x."""

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray


class EvaluationError(ValueError):
    """f raised, returned NaN or returned something that is not one number per row."""


def one_per_row(outcomes: ArrayLike, n: int) -> NDArray[np.float64]:
    """Return the outcomes as float64, shape (n,).

    Raises:
        EvaluationError: If they are not n real numbers.
    """
    try:
        if np.iscomplexobj(outcomes):
            raise TypeError("complex numbers have no order")
        f = np.asarray(outcomes, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise EvaluationError(f"Expected f to return shape ({n},), one number per row of x: {error}") from error
    if f.shape != (n,):
        raise EvaluationError(f"Expected f to return shape ({n},), one value per row of x, got {f.shape}.")
    return f


def where(x: NDArray[np.float64], row: int) -> str:
    """Return words that name a row of a batch x (n, d)."""
    shown = np.array2string(x[row], precision=6, threshold=8, separator=", ", max_line_width=10**6)
    return f"row {row} of a batch of {len(x)}, x = {shown}"


OnError = Literal["raise", "failure", "bound"]


ON_ERROR: tuple[str, ...] = get_args(OnError)
