"""Rows of a batch: replaced, picked, and in Gymnasium's vector form with their mask."""

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.measures.base import RowsReplaceable
from rare_envs.sensors.kinds import each

T = TypeVar("T")


def merge_rows(old: T, rows: Tensor, new: T) -> T:
    """Tensors, tuples of such or a `RowsReplaceable`, with some rows replaced; the rest, as the road, is common."""
    result: T = _merge_rows(old, rows, new)
    return result


def _merge_rows(old: Any, rows: Tensor, new: Any) -> Any:
    if isinstance(old, Tensor):
        old = old.clone()
        old[rows] = new
        return old
    if isinstance(old, tuple):
        parts = [_merge_rows(a, rows, b) for a, b in zip(old, new, strict=True)]
        return type(old)(*parts) if hasattr(old, "_fields") else tuple(parts)
    return old.replace_rows(rows, new) if isinstance(old, RowsReplaceable) else old


def to_object_rows(observation: Any, mask: NDArray[np.bool_]) -> NDArray[Any]:
    """Rows of an observation as objects, None where the mask is not set: Gymnasium's form of `final_obs`."""
    rows = np.full(len(mask), None, dtype=object)
    for row in np.flatnonzero(mask):
        rows[row] = each(lambda part, row=row: part[row].copy(), observation)
    return rows


def replace_rows(observation: Any, rows: NDArray[np.intp], fresh: Any) -> Any:
    """An observation with some of its rows replaced."""

    def replaced(old: NDArray[Any], new: NDArray[Any]) -> NDArray[Any]:
        old = old.copy()
        old[rows] = new
        return old

    return each(replaced, observation, fresh)


def put_masked(infos: dict[str, Any], key: str, value: Any, mask: NDArray[np.bool_]) -> None:
    """An entry with its mask, in Gymnasium's vector form."""
    infos[key] = value
    infos[f"_{key}"] = mask.copy()
