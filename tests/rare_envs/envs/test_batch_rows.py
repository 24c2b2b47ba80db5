"""Rows of a batch: drawn ahead, replaced in whatever holds them, and in Gymnasium's forms."""

from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from rare_envs.distributions import BetaDistribution, NoiseDistribution, ProductDistribution, TruncatedGaussianMixture
from rare_envs.distributions.space import Distribution
from rare_envs.envs.rows_and_infos import ROWS_AHEAD, DrawsAhead, merge_rows, put_masked, replace_rows, to_object_rows

BETA = BetaDistribution([2.0, 0.5], [2.0, 3.0], [0.0, 1.0], [1.0, 4.0])
MIXTURE = TruncatedGaussianMixture([0.4, 0.6], [[0.0], [2.0]], [[[1.0]], [[0.3]]], [-1.0], [3.0])


@pytest.mark.parametrize("base", [BETA, MIXTURE, ProductDistribution((BETA, NoiseDistribution(1)))])
def test_rows_drawn_ahead_are_those_drawn_one_call_after_the_other(base: Distribution) -> None:
    ahead, rng, plain = DrawsAhead(base), *(np.random.default_rng(3) for _ in range(2))
    for n in (1, 3, ROWS_AHEAD - 5, 2, 0, ROWS_AHEAD + 7, 1):
        np.testing.assert_array_equal(ahead.sample(n, rng), base.sample(n, plain))
    ahead.settle()
    assert rng.bit_generator.state == plain.bit_generator.state
    for n in (2, 4):  # another generator begins anew
        other, same = (np.random.default_rng(n) for _ in range(2))
        np.testing.assert_array_equal(ahead.sample(n, other), base.sample(n, same))


@pytest.mark.parametrize("kind", [np.random.PCG64, np.random.MT19937])
def test_a_generator_that_others_draw_from_too_is_not_put_back(kind: type[np.random.BitGenerator]) -> None:
    """Their draws would come again."""
    ahead, rng = DrawsAhead(BETA), np.random.Generator(kind(3))
    ahead.sample(1, rng)
    others = rng.random(5)
    ahead.settle()
    assert not np.isin(rng.random(10 * ROWS_AHEAD), others).any()


def test_rows_drawn_ahead_are_the_callers_own() -> None:
    ahead, rng = DrawsAhead(BETA), np.random.default_rng(0)
    ahead.sample(1, rng)[:] = np.nan
    assert np.isfinite(ahead.sample(1, rng)).all()


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
