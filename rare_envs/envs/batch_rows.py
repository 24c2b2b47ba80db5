"""Rows of a batch: replaced, picked, and in Gymnasium's vector form with their mask."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.measures.base import RowsReplaceable
from rare_envs.sensors.kinds import map_kinds

_T = TypeVar("_T")


def merge_rows(old: _T, rows: Tensor, new: _T) -> _T:
    """Return tensors, tuples of such or `RowsReplaceable` with some rows replaced; the rest, as the road, is common.

    Args:
        old: Of B scenarios.
        rows: Indices of R of them, shape (R,).
        new: Of R scenarios.

    Example:
        >>> import torch
        >>> merge_rows((torch.zeros(3), "road"), torch.tensor([1]), (torch.ones(1), "road"))
        (tensor([0., 1., 0.]), 'road')
    """
    result: _T = _merge(old, rows, new)
    return result


def _merge(old: Any, rows: Tensor, new: Any) -> Any:
    if isinstance(old, Tensor):
        old = old.clone()
        old[rows] = new
        return old
    if isinstance(old, tuple):
        parts = [_merge(a, rows, b) for a, b in zip(old, new, strict=True)]
        return tuple(parts) if type(old) is tuple else type(old)(*parts)  # a named tuple takes its fields one by one
    return old.replace_rows(rows, new) if isinstance(old, RowsReplaceable) else old


def to_object_rows(observation: Any, mask: NDArray[np.bool_]) -> NDArray[Any]:
    """Return rows of an observation as objects, None where the mask is not set: Gymnasium's form of `final_obs`.

    Args:
        observation: Of B environments.
        mask: Boolean, shape (B,).
    """
    rows = np.full(len(mask), None, dtype=object)
    for row in np.flatnonzero(mask):
        rows[row] = map_kinds(lambda part, row=row: part[row].copy(), observation)
    return rows


def replace_rows(observation: Any, rows: NDArray[np.intp], fresh: Any) -> Any:
    """Return an observation with R of its rows replaced.

    Args:
        observation: Of B environments.
        rows: Indices, shape (R,).
        fresh: Of R environments.
    """

    def replace(old: NDArray[Any], new: NDArray[Any]) -> NDArray[Any]:
        old = old.copy()
        old[rows] = new
        return old

    return map_kinds(replace, observation, fresh)


def put_masked(infos: dict[str, Any], key: str, value: Any, mask: NDArray[np.bool_]) -> None:
    """Put an entry with its mask into infos, in Gymnasium's vector form.

    Example:
        >>> infos = {}
        >>> put_masked(infos, "speed", [20.0, 0.0], np.array([True, False]))
        >>> infos
        {'speed': [20.0, 0.0], '_speed': array([ True, False])}
    """
    infos[key] = value
    infos[f"_{key}"] = mask.copy()
