"""Products: densities add up, maps go block by block, and noise is known by its columns."""

import numpy as np
import pytest

from rare_envs.distributions.beta import BetaDistribution
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.product import (
    BlockDistribution,
    FittedProduct,
    NoiseDistribution,
    ProductDistribution,
    join_independent,
)
from tests.rare_envs.distributions.test_fitted import BASE

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


# --- with a fitted block ------------------------------------------------------------------------------


def test_a_product_with_one_fitted_block_is_fitted_too() -> None:
    whole = join_independent(BASE, BETA, NoiseDistribution(2))
    assert isinstance(whole, FittedProduct)
    assert isinstance(whole, BlockDistribution)
    assert (whole.dim, whole.noise.tolist()) == (6, [False] * 4 + [True] * 2)
    assert [type(block) for block in whole.blocks] == [type(BASE.distribution), BetaDistribution, NoiseDistribution]
    assert (whole.fitted_to, whole.clusters, whole.family) == (BASE.fitted_to, BASE.clusters, BASE.family)
    assert (whole.frequency, whole.checks, whole.record) == (BASE.frequency, BASE.checks, BASE.record)


@pytest.mark.parametrize("first", [True, False])
def test_a_refit_replaces_its_block_alone(first: bool) -> None:
    whole = join_independent(*((BASE, BETA) if first else (BETA, BASE)))
    assert isinstance(whole, FittedProduct)
    x = whole.sample(50, np.random.default_rng(0))
    own, rest = (x[:, :3], x[:, 3:]) if first else (x[:, 1:], x[:, :1])
    assert len(whole.refits) == 3
    for product, refit in zip(whole.refits, BASE.refits, strict=True):
        np.testing.assert_allclose(product.log_prob(x), refit.log_prob(own) + BETA.log_prob(rest), rtol=1e-12)
    ensemble = BASE.ensemble().log_prob(own) + BETA.log_prob(rest)
    np.testing.assert_allclose(whole.ensemble().log_prob(x), ensemble, rtol=1e-12)


def test_a_product_of_a_fitted_product_and_a_sibling() -> None:
    found = FittedDistribution.from_dict(BASE.to_dict(), siblings={"i80": BASE}.__getitem__)
    inner = join_independent(found, BETA)
    outer = join_independent(inner, NoiseDistribution(1))
    assert isinstance(outer, FittedProduct)
    assert [block.dim for block in outer.blocks] == [3, 1, 1]
    assert [refit.dim for refit in outer.refits] == [5] * 3
    other = outer.sibling("i80")
    assert isinstance(other, FittedProduct)
    assert (other.dim, other.fitted_to) == (5, BASE.fitted_to)
    assert join_independent(inner) is inner
    with pytest.raises(ValueError, match="A file holds mixtures and Beta variables, no ProductDistribution"):
        outer.to_dict()


def test_refits_of_two_fitted_blocks_do_not_belong_together() -> None:
    both = join_independent(BASE, BASE)
    assert type(both) is ProductDistribution
    assert [type(block) for block in both.blocks] == [type(BASE.distribution)] * 2
