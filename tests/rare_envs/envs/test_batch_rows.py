"""Rows of a batch: replaced in whatever holds them, and in Gymnasium's forms."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rare_envs.envs.batch_rows import merge_rows, put_masked, replace_rows, to_object_rows


class Pair(NamedTuple):
    left: Tensor
    right: object


def test_rows_are_replaced_in_tensors_tuples_and_what_lies_in_them() -> None:
    old = (Pair(torch.zeros(3), "road"), (torch.zeros(3, 2), None))
    new = (Pair(torch.ones(2), "another"), (torch.ones(2, 2), None))
    merged = merge_rows(old, torch.tensor([2, 0]), new)
    assert isinstance(merged[0], Pair)
    assert merged[0].left.tolist() == [1.0, 0.0, 1.0]
    assert merged[0].right == "road"  # common to all
    assert merged[1][0][:, 1].tolist() == [1.0, 0.0, 1.0]
    assert old[0].left.tolist() == [0.0] * 3  # the old ones stay


def test_measures_that_keep_objects_replace_rows_themselves() -> None:
    class Kept:
        def replace_rows(self, rows: Tensor, new: object) -> tuple[str, list[int], object]:
            return "replaced", rows.tolist(), new

    assert merge_rows(Kept(), torch.tensor([1]), "fresh") == ("replaced", [1], "fresh")


def test_observations_by_name_and_alone() -> None:
    mask = np.array([True, False])
    for observed in (np.arange(4.0).reshape(2, 2), {"a": np.arange(2.0), "b": np.arange(2.0)}):
        rows = to_object_rows(observed, mask)
        assert [row is None for row in rows] == [False, True]
    fresh = replace_rows({"a": np.zeros((3, 2))}, np.array([1]), {"a": np.ones((1, 2))})
    assert fresh["a"].sum(axis=1).tolist() == [0.0, 2.0, 0.0]


def test_entries_have_their_mask() -> None:
    infos: dict[str, object] = {}
    mask = np.array([True, False])
    put_masked(infos, "speed", [1.0, 2.0], mask)
    mask[1] = True
    assert infos["_speed"].tolist() == [True, False]  # type: ignore[attr-defined]
