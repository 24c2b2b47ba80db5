"""Rows of a batch: replaced, picked, and in Gymnasium's vector form with their mask."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.measures.base import RowsReplaceable
from rare_envs.sensors.kinds import map_kinds
from rare_envs.traffic.tensor_trees import map_leaves, map_tensors

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

    def merge(old: Any, new: Any) -> Any:
        if not isinstance(old, Tensor):
            replace = getattr(old, "replace_rows", None)  # of a `RowsReplaceable`; to ask for the protocol is slow
            return old if replace is None else replace(rows, new)
        old = old.clone()
        old[rows] = new
        return old

    result: _T = map_leaves(merge, old, new)
    return result


def list_tensors(value: Any) -> list[Tensor]:
    """Return the tensors in nested tuples, in their order; the rest, as the road, stays the same for a whole batch.

    Raises:
        ValueError: A part keeps its rows in a way of its own.

    Example:
        >>> import torch
        >>> list_tensors((torch.zeros(1), ("road", torch.ones(1))))
        [tensor([0.]), tensor([1.])]
    """
    found = list[Tensor]()

    def collect(leaf: Any) -> None:
        if isinstance(leaf, RowsReplaceable):
            raise ValueError(f"Expected tensors, to keep them in a file, got {type(leaf).__name__}.")
        if isinstance(leaf, Tensor):
            found.append(leaf)

    map_leaves(collect, value)
    return found


def put_tensors(value: _T, tensors: Iterator[Tensor]) -> _T:
    """Return nested tuples with other tensors in the places of `list_tensors`.

    Raises:
        ValueError: A tensor has another shape or type, or there are too few.
    """

    def put(old: Tensor) -> Tensor:
        new = next(tensors, None)
        if new is None or new.shape != old.shape or new.dtype != old.dtype:
            raise ValueError(f"Expected a tensor of {old.dtype} and shape {tuple(old.shape)}.")
        return new

    result: _T = map_tensors(put, value)
    return result


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
