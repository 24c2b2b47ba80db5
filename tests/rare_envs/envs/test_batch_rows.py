"""Rows of a batch: drawn ahead, replaced in whatever holds them, and in Gymnasium's forms."""

import numpy as np
import pytest

from rare_envs.distributions import BetaDistribution, NoiseDistribution, ProductDistribution, TruncatedGaussianMixture
from rare_envs.distributions.space import Distribution
from rare_envs.envs.rows_and_infos import ROWS_AHEAD, DrawsAhead

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
