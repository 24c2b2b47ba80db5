"""Components of proposals: draws, densities and fits."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from samplers.proposals import (
    HalfSpaceIntersection,
    IsotropicNormal,
    LiftedComponent,
    RadialLaw,
    SubspaceGaussian,
    VonMisesFisherNakagami,
    draw_counts,
)

N = 20_000


def rotation(dim, seed=0):
    return np.linalg.qr(np.random.default_rng(seed).standard_normal((dim, dim)))[0]


def subspace_gaussian(dim, rank, seed=0):
    """Along `rank` of the directions: means to 1.5, variances 0.7 to 1.5."""
    axes = rotation(dim, seed)[:, :rank]
    return SubspaceGaussian(axes, np.linspace(-0.5, 1.5, rank), np.linspace(0.7, 1.5, rank))


def oblique_corner(dim):
    """Three planes at 60 degrees to each other."""
    axes = rotation(dim, 4)[:3]
    axes = axes + axes.sum(axis=0) / 3
    return HalfSpaceIntersection(axes / np.linalg.norm(axes, axis=1)[:, None], np.array([1.5, 1.2, -0.3]))


def vmfn(dim, kappa):
    mu = np.arange(1.0, dim + 1)
    return VonMisesFisherNakagami(mu / np.linalg.norm(mu), kappa, 3.0, 16.0)


COMPONENTS = {
    "base": (IsotropicNormal(4), 4),
    "wide": (IsotropicNormal(2, 1.5), 2),
    "gaussian d=1": (subspace_gaussian(1, 1), 1),
    "three directions of 6": (subspace_gaussian(6, 3), 6),
    "tempered": (subspace_gaussian(6, 3).temper(0.5), 6),
    "half-space": (HalfSpaceIntersection(rotation(3, 4)[:1], np.array([2.0])), 3),
    "half-space behind the origin": (HalfSpaceIntersection(rotation(3, 4)[:1], np.array([-0.5])), 3),
    "oblique corner d=5": (oblique_corner(5), 5),
    "radial d=20": (RadialLaw(20, 12.0, 2.0, 4.0), 20),
    "radial in a plane of 10": (LiftedComponent(RadialLaw(2, 1.0, 1.5, 2.5), rotation(10, 6)[:, :2]), 10),
    **{f"directions d={dim}": (vmfn(dim, 2.0), dim) for dim in (1, 2, 3, 6)},
}
each = pytest.mark.parametrize(("component", "dim"), COMPONENTS.values(), ids=COMPONENTS)


def grid(dim):
    """Midpoints of cells and their probability under N(0, I): a rule for E_phi, d = 1 or 2."""
    edges = np.linspace(-24, 24, 200_001) if dim == 1 else np.linspace(-12, 12, 601)
    t, width = 0.5 * (edges[1:] + edges[:-1]), edges[1] - edges[0]
    u = t[:, None] if dim == 1 else np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
    return u, stats.norm.pdf(u).prod(axis=1) * width**dim


@each
def test_draws_and_ratio_are_of_one_density(component, dim, rng):
    """E_q[1 / (1 + r)] = E_phi[r / (1 + r)] for r = q / phi: both terms are bounded, whatever the weights."""
    own = 1 / (1 + np.exp(component.log_ratio(component.sample(N, rng))))
    base = 1 - 1 / (1 + np.exp(component.log_ratio(rng.standard_normal((N, dim)))))
    error = math.sqrt((own.var() + base.var()) / N)
    assert own.mean() == pytest.approx(base.mean(), abs=4 * error + 1e-12)


@pytest.mark.parametrize("dim", [1, 2])
@pytest.mark.parametrize("power", [0.0, 0.3, 0.5, 1.0])
def test_tempered_is_the_normalised_geometric_mean_with_the_base(dim, power):
    component = SubspaceGaussian(rotation(dim, 3), np.array([2.5, -1.0])[:dim], np.array([0.3, 1.8])[:dim])
    u, mass = grid(dim)
    log_q = power * component.log_ratio(u)
    expected = log_q - math.log((mass * np.exp(log_q)).sum())
    near = np.linalg.norm(u, axis=1) < 6
    np.testing.assert_allclose(component.temper(power).log_ratio(u)[near], expected[near], atol=1e-7)


@given(
    st.lists(st.floats(0, 1), min_size=1, max_size=12).filter(lambda w: sum(w) > 1e-3),
    st.integers(0, 10_000),
    st.integers(0, 2**32),
)
def test_counts_are_within_one_of_their_expectation(weights, n, seed):
    weights = np.array(weights)
    counts = draw_counts(weights, n, np.random.default_rng(seed))
    assert counts.sum() == n
    assert (counts >= 0).all()
    assert (np.abs(counts - n * weights / weights.sum()) < 1 + 1e-6).all()


@pytest.mark.parametrize("dim", [1, 2, 5, 50])
def test_fit_recovers_the_distribution(rng, dim):
    distribution = vmfn(dim, 1.0 if dim == 1 else 8.0)
    found = VonMisesFisherNakagami.fit(distribution.sample(50_000, rng), np.full(50_000, 1 / 50_000))
    assert found.mu @ distribution.mu > 0.995
    assert found.m == pytest.approx(3.0, rel=0.05)
    assert found.omega == pytest.approx(16.0, rel=0.02)
    if dim > 2:  # Banerjee's formula is an approximation, poor on the line and fair in the plane
        assert found.kappa == pytest.approx(8.0, rel=0.05)
