"""Trees of tensors: nested tuples, named or not, whose leaves are tensors and what is common to a whole batch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor


def map_leaves(function: Callable[..., Any], tree: Any, *others: Any) -> Any:
    """Return the tree with a function of its leaves, and of those of others of the same form, in their places.

    Example:
        >>> map_leaves(lambda old, new: max(old, new), (1, (5, 2)), (3, (4, 6)))
        (3, (5, 6))
    """
    if not isinstance(tree, tuple):
        return function(tree, *others)
    parts = [map_leaves(function, *each) for each in zip(tree, *others, strict=True)]
    return tuple(parts) if type(tree) is tuple else type(tree)(*parts)  # a named tuple takes its fields one by one


def map_tensors(function: Callable[[Tensor], Any], tree: Any) -> Any:
    """Return the tree with a function of its tensors in their places; the rest, as the road, stays.

    Example:
        >>> import torch
        >>> map_tensors(lambda part: part[1:], (torch.arange(3), "road"))
        (tensor([1, 2]), 'road')
    """
    return map_leaves(lambda leaf: function(leaf) if isinstance(leaf, Tensor) else leaf, tree)
