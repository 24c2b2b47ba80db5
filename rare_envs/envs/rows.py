"""Rows of a batch: replaced, picked, and in Gymnasium's vector form with their mask."""

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

T = TypeVar("T")


def merged(old: T, rows: Tensor, new: T) -> T:
    """Tensors, tuples of such or what knows how (`put`), with some rows replaced; the rest, as the road, is common."""
    result: T = _merged(old, rows, new)
    return result


def _merged(old: Any, rows: Tensor, new: Any) -> Any:
    if isinstance(old, Tensor):
        old = old.clone()
        old[rows] = new
        return old
    if isinstance(old, tuple):
        parts = [_merged(a, rows, b) for a, b in zip(old, new, strict=True)]
        return type(old)(*parts) if hasattr(old, "_fields") else tuple(parts)
    return old.put(rows, new) if hasattr(old, "put") else old


def rows_of(values: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
    """Rows as objects, None where the mask is not set: Gymnasium's form of `final_obs`."""
    rows = np.full(len(values), None, dtype=object)
    for row in np.flatnonzero(mask):
        rows[row] = values[row].copy()
    return rows


def put(infos: dict[str, Any], key: str, value: Any, mask: NDArray[np.bool_]) -> None:
    """An entry with its mask, in Gymnasium's vector form."""
    infos[key] = value
    infos[f"_{key}"] = mask.copy()
