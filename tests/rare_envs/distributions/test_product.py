"""Products: densities add up, maps go block by block, and noise is known by its columns."""

import numpy as np
import pytest

from rare_envs.distributions.beta import BetaDistribution
from rare_envs.distributions.product import (
    BlockDistribution,
    NoiseDistribution,
    ProductDistribution,
    join_independent,
)

BETA = BetaDistribution([2.0], [3.0], [0.0], [10.0])


def test_densities_add_up_and_maps_go_block_by_block() -> None:
    both = join_independent(BETA, NoiseDistribution(2))
    assert isinstance(both, ProductDistribution)
    assert (both.dim, both.noise.tolist()) == (3, [False, True, True])
    x = both.sample(50, np.random.default_rng(0))
    normal = -0.5 * (x[:, 1:] ** 2).sum(axis=1) - np.log(2.0 * np.pi)
    np.testing.assert_allclose(both.log_prob(x), BETA.log_prob(x[:, :1]) + normal, rtol=1e-12)
    u = both.to_standard_normal(x)
    np.testing.assert_array_equal(u[:, 1:], x[:, 1:])
    np.testing.assert_array_equal(u[:, :1], BETA.to_standard_normal(x[:, :1]))
    np.testing.assert_allclose(both.from_standard_normal(u), x, rtol=1e-9)


def test_blocks_of_products_stand_side_by_side() -> None:
    inner = join_independent(BETA, NoiseDistribution(2))
    outer = join_independent(inner, NoiseDistribution(1))
    assert isinstance(outer, BlockDistribution)
    assert [block.dim for block in outer.blocks] == [1, 2, 1]
    assert join_independent(BETA) is BETA


def test_noise_does_not_move() -> None:
    noise, rng = NoiseDistribution(3), np.random.default_rng(0)
    assert noise.project(rng.standard_normal((5, 3)), np.ones(5), 0.5) is noise
    assert noise.widen(2.0) is noise
    assert noise.log_prob(np.zeros((1, 3))).item() == pytest.approx(-1.5 * np.log(2.0 * np.pi))
