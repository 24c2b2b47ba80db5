import math

import numpy as np
import pytest
from scipy import stats
from scipy.special import iv

from samplers.components import VonMisesFisherNakagami, concentration, directions, log_normaliser
from samplers.problem import StandardNormal


@pytest.mark.parametrize("dim", [1, 2, 3, 20, 100, 1500])
def test_the_standard_normal_distribution_is_one(rng, dim):
    u = rng.standard_normal((50, dim))
    np.testing.assert_allclose(
        VonMisesFisherNakagami.standard(dim).log_prob(u), StandardNormal(dim).log_prob(u), atol=2e-3
    )


@pytest.mark.parametrize("dim", [2, 3, 10, 41, 42, 43, 60])
@pytest.mark.parametrize("kappa", [0.5, 5.0, 80.0])
def test_normaliser_on_both_sides_of_the_expansion(dim, kappa):
    v = dim / 2 - 1
    exact = v * math.log(kappa) - dim / 2 * math.log(2 * math.pi) - math.log(iv(v, kappa))
    assert log_normaliser(kappa, dim) == pytest.approx(exact, abs=1e-6)


def test_normaliser_of_two_directions():
    """On the line the density of the direction mu is exp(kappa) / (2 cosh kappa)."""
    assert log_normaliser(1.3, 1) == pytest.approx(-math.log(2 * math.cosh(1.3)))


def vmfn(dim, kappa=8.0):
    mu = np.arange(1.0, dim + 1)
    return VonMisesFisherNakagami(mu / np.linalg.norm(mu), kappa, 3.0, 16.0)


@pytest.mark.parametrize("dim", [1, 2, 3, 6])
def test_draws_have_the_density(rng, dim):
    """Integral over another distribution: E_q[p / q] = 1 and the same moments either way."""
    distribution = vmfn(dim, 2.0)
    u = 4 * rng.standard_normal((200_000, dim))
    weights = np.exp(distribution.log_prob(u) - stats.norm(0, 4).logpdf(u).sum(axis=1))
    assert weights.mean() == pytest.approx(1, abs=5 * weights.std() / math.sqrt(len(u)))
    drawn = distribution.sample(200_000, rng)
    error = 6 * (weights[:, None] * u).std(axis=0) / math.sqrt(len(u))
    assert (abs((weights[:, None] * u).mean(axis=0) - drawn.mean(axis=0)) < error).all()
    assert (drawn**2).sum(axis=1).mean() == pytest.approx(16, rel=0.02)


@pytest.mark.parametrize("dim", [1, 2, 5, 50])
def test_fit_recovers_the_distribution(rng, dim):
    distribution = vmfn(dim, 1.0 if dim == 1 else 8.0)
    found = VonMisesFisherNakagami.fit(distribution.sample(50_000, rng), np.full(50_000, 1 / 50_000))
    assert found.mu @ distribution.mu > 0.995
    assert found.m == pytest.approx(3.0, rel=0.05)
    assert found.omega == pytest.approx(16.0, rel=0.02)
    if dim > 2:  # Banerjee's formula is an approximation, poor on the line and fair in the plane
        assert found.kappa == pytest.approx(8.0, rel=0.05)


def test_weights_count(rng):
    """Points under weights p / q are points of p."""
    distribution = vmfn(3)
    u = 4 * rng.standard_normal((200_000, 3))
    log_weights = distribution.log_prob(u) - stats.norm(0, 4).logpdf(u).sum(axis=1)
    found = VonMisesFisherNakagami.fit(u, np.exp(log_weights))
    assert found.mu @ distribution.mu > 0.999
    assert found.m == pytest.approx(3.0, rel=0.05)


def test_no_concentration_out_of_noise(rng):
    """500 points without a direction in 400 dimensions have a mean direction of length 0.045."""
    u = rng.standard_normal((500, 400))
    assert VonMisesFisherNakagami.fit(u, np.full(500, 1 / 500)).kappa < 8  # the length alone would say 18


def test_concentration_grows_with_the_resultant():
    lengths = [0.0, 0.1, 0.5, 0.9, 1.0]
    kappas = [concentration(length, 5) for length in lengths]
    assert kappas == sorted(kappas)
    assert 0 < kappas[0] < kappas[-1] < math.inf


def test_few_points_give_a_finite_distribution():
    one = VonMisesFisherNakagami.fit(np.array([[1.0, 2.0]]), np.ones(1))
    assert np.isfinite(one.log_prob(np.array([[1.0, 2.0], [-3.0, 0.0], [0.0, 0.0]]))).all()


def test_widened(rng):
    distribution = vmfn(4, 30.0)
    wide = distribution.widen(2.0)
    tight, loose = distribution.sample(20_000, rng), wide.sample(20_000, rng)
    assert (loose**2).sum(axis=1).mean() == pytest.approx((tight**2).sum(axis=1).mean(), rel=0.05)
    assert loose.std(axis=0).mean() > 1.5 * tight.std(axis=0).mean()


@pytest.mark.parametrize("dim", [1, 2, 7])
def test_directions_have_length_one(rng, dim):
    a = directions(vmfn(dim).mu, 3.0, 1000, rng)
    assert a.shape == (1000, dim)
    np.testing.assert_allclose(np.linalg.norm(a, axis=1), 1)


@pytest.mark.parametrize("dim", [2, 7, 120])
def test_ratio_to_the_base_is_that_of_the_densities(dim, rng):
    law = VonMisesFisherNakagami(np.eye(dim)[0], 3.0, dim / 3, 1.5 * dim)
    u = rng.standard_normal((50, dim))
    expected = law.log_prob(u) - stats.norm.logpdf(u).sum(axis=1)
    np.testing.assert_allclose(law.log_ratio(u), expected, rtol=1e-10, atol=1e-9)
