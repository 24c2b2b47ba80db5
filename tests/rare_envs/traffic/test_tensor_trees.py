"""Trees keep their form, and their tensors alone are changed."""

from typing import NamedTuple

import pytest
import torch

from rare_envs.traffic.state import map_leaves, map_tensors


class Pair(NamedTuple):
    left: object
    right: object


def test_named_and_nested_tuples_keep_their_types() -> None:
    tree = Pair(torch.arange(3.0), (Pair("road", torch.zeros(3, 2)), None))
    found = map_tensors(lambda part: part[:1] + 1, tree)
    assert type(found) is Pair and type(found.right) is tuple and type(found.right[0]) is Pair
    assert found.left.tolist() == [1.0]
    assert found.right[0].left == "road" and found.right[1] is None
    assert found.right[0].right.tolist() == [[1.0, 1.0]]


def test_trees_of_other_forms_are_refused() -> None:
    with pytest.raises(ValueError, match="zip"):
        map_leaves(lambda a, b: a, (1, 2), (1,))
