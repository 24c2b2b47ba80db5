"""Beta variables: SciPy's density, the exact map, and what is refused."""

import numpy as np
import pytest
from scipy import stats

from rare_envs.distributions.beta import BetaDistribution

BETA = BetaDistribution([2.0, 0.7], [5.0, 1.3], [-1.0, 10.0], [3.0, 20.0])
PARTS = (stats.beta(2.0, 5.0, loc=-1.0, scale=4.0), stats.beta(0.7, 1.3, loc=10.0, scale=10.0))


def test_density_and_map_are_scipys() -> None:
    x = BETA.sample(200, np.random.default_rng(0))
    expected = sum(part.logpdf(column) for part, column in zip(PARTS, x.T, strict=True))
    np.testing.assert_allclose(BETA.log_prob(x), expected, rtol=1e-10)
    u = np.column_stack([stats.norm.ppf(part.cdf(column)) for part, column in zip(PARTS, x.T, strict=True)])
    np.testing.assert_allclose(BETA.to_standard_normal(x), u, atol=1e-9)
    np.testing.assert_allclose(BETA.from_standard_normal(u), x, rtol=1e-9)


def test_tails_are_exact_on_both_sides() -> None:
    u = np.array([[-8.0, -8.0], [8.0, 8.0]])
    x = BETA.from_standard_normal(u)
    assert ((BETA.low <= x) & (x <= BETA.high)).all()
    # of Beta(a, b) the lower tail is z^a / (a B(a, b)) near 0
    z = (x[0, 0] + 1.0) / 4.0
    assert z**2 / (2.0 / 30.0) == pytest.approx(stats.norm.cdf(-8.0), rel=1e-3)
    assert BETA.log_prob(np.array([[-1.1, 15.0], [0.0, 20.1]])).tolist() == [-np.inf, -np.inf]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([2.0], [1.0, 1.0], [0.0], [1.0]), "one shape"),
        (([0.0], [1.0], [0.0], [1.0]), "positive alpha and beta"),
        (([2.0], [np.nan], [0.0], [1.0]), "positive alpha and beta"),
        (([2.0], [1.0], [1.0], [1.0]), "low < high"),
    ],
)
def test_what_is_no_distribution_is_refused(arguments: tuple[list[float], ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BetaDistribution(*arguments)
    with pytest.raises(ValueError, match="no beta, low, high"):
        BetaDistribution.from_dict({"alpha": [1.0]})


def test_rows_that_repeat_the_first_are_mapped_as_alone():
    rng = np.random.default_rng(5)
    shapes = rng.uniform(1.0, 5.0, (2, 6))
    distribution = BetaDistribution(*shapes, np.full(6, -2.0), np.full(6, 3.0))
    u = np.repeat(3.0 * rng.standard_normal((1, 6)), 9, axis=0)
    u[2, 1], u[4, 3:], u[6, 0] = 0.0, rng.standard_normal(3), np.inf
    alone = np.concatenate([distribution.from_standard_normal(row[None]) for row in u])
    assert np.array_equal(distribution.from_standard_normal(u), alone)
    assert distribution.from_standard_normal(u[:0]).shape == (0, 6)


def test_gradients_are_pulled_back_by_the_slope_of_the_map() -> None:
    """dx / du by central differences, to h^2 = 1e-8; far out both are of the nearer tail."""
    u = np.column_stack([np.linspace(-6.0, 6.0, 25), np.linspace(5.0, -5.0, 25)])
    gradients, h = np.random.default_rng(0).standard_normal(u.shape), 1e-4
    slopes = (BETA.from_standard_normal(u + h) - BETA.from_standard_normal(u - h)) / (2 * h)
    np.testing.assert_allclose(BETA.pull_back(u, gradients), slopes * gradients, rtol=1e-5, atol=1e-9)
    assert np.isfinite(BETA.pull_back(np.full((1, 2), -15.0), np.ones((1, 2)))).all()
