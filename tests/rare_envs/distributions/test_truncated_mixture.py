"""The truncated mixture against integrals and densities computed another way."""

import itertools
import json

import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtri_exp

from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.mixture import CHUNK_ROWS, CoordinateMixture, TruncatedGaussianMixture
from rare_envs.scenarios.base_distributions import load_base
from rare_envs.scenarios.registry import SCENARIOS, scenario_named

SHIPPED = [
    (env_id, base)
    for env_id, each in SCENARIOS.items()
    if each.drivers is None
    for base in each.bases
    if "closing_behind" not in str(load_base(each, base).to_dict())  # these have a range of their own in each row
]


def unwrap(base):
    return base.distribution if isinstance(base, FittedDistribution) else base


def random_mixture(seed, components, d, low, high):
    rng = np.random.default_rng(seed)
    roots = rng.standard_normal((components, d, d))
    covariances = roots @ roots.transpose(0, 2, 1) + 0.2 * np.eye(d)
    means = 2.0 * rng.standard_normal((components, d))
    weights = rng.dirichlet(np.full(components, 3.0))
    return TruncatedGaussianMixture(weights, means, covariances, [low] * d, [high] * d)


# (seed, components, d, low, high): wide boxes, boxes through the bulk, boxes far in a tail.
WIDE = (1, 3, 2, -15.0, 15.0)
CUT = (2, 3, 2, -1.0, 2.0)
TAIL = (3, 2, 2, 5.0, 7.0)
CUT_3D = (4, 2, 3, -1.5, 2.5)
ONE_3D = (5, 1, 3, 0.0, 4.0)
MANY = (6, 10, 3, -6.0, 6.0)
CASES = [WIDE, CUT, TAIL, CUT_3D, ONE_3D, MANY]


def grid(law, nodes):
    """Gauss-Legendre points and weights on the box; also the one-dimensional rules."""
    t, w = np.polynomial.legendre.leggauss(nodes)
    half = 0.5 * (law.high - law.low)
    axes = [law.low[j] + half[j] * (t + 1.0) for j in range(law.dim)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, law.dim)
    weights = np.ones(1)
    for j in range(law.dim):
        weights = np.outer(weights, half[j] * w).ravel()
    return axes, points, weights


def marginal(law, x):
    """Density of the untruncated mixture's first x.shape[1] coordinates, by SciPy."""
    k = x.shape[1]
    if k == 0:
        return np.ones(len(x))
    parts = zip(law.weights, law.means, law.covariances, strict=True)
    return sum(w * np.atleast_1d(stats.multivariate_normal(m[:k], c[:k, :k]).pdf(x)) for w, m, c in parts)


def reference_density(law, x):
    """The definition: product of conditionals, each divided by its integral over its range."""
    t, w = np.polynomial.legendre.leggauss(400)
    density = np.ones(len(x))
    for j in range(law.dim):
        half = 0.5 * (law.high[j] - law.low[j])
        nodes = law.low[j] + half * (t + 1.0)
        line = np.repeat(x[:, : j + 1], len(t), axis=0)
        line[:, j] = np.tile(nodes, len(x))
        mass = marginal(law, line).reshape(len(x), -1) @ (half * w)
        density *= marginal(law, x[:, : j + 1]) / mass
    return density


@pytest.mark.parametrize("case", CASES)
def test_density_is_the_product_of_cut_conditionals(case):
    law = random_mixture(*case)
    x = np.random.default_rng(0).uniform(law.low, law.high, (50, law.dim))
    np.testing.assert_allclose(np.exp(law.log_prob(x)), reference_density(law, x), rtol=1e-8)


@pytest.mark.parametrize("case", CASES)
def test_density_integrates_to_one(case):
    law = random_mixture(*case)
    _, points, weights = grid(law, 200 if law.dim == 2 else 64)
    assert np.exp(law.log_prob(points)) @ weights == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(("scenario", "base"), SHIPPED)
def test_shipped_density_integrates_to_one_by_importance_sampling(scenario, base):
    law = unwrap(load_base(scenario_named(scenario), base))
    rng = np.random.default_rng(11)
    n = 100_000
    counts = rng.multinomial(n, law.weights)
    parts = zip(law.means, law.covariances, counts, strict=True)
    z = np.concatenate([rng.multivariate_normal(m, c, k) for m, c, k in parts])
    logarithmic = [kind == "log" for kind in law.coordinates.kinds] if isinstance(law, CoordinateMixture) else False
    x = np.where(logarithmic, np.exp(z), z)
    ratio = np.exp(law.log_prob(x)) * np.where(logarithmic, x, 1.0).prod(axis=1) / marginal(law, z)
    error = ratio.std() / np.sqrt(n)
    assert error < 0.005
    assert abs(ratio.mean() - 1.0) < 4.0 * error


def test_no_density_outside_the_box():
    law = random_mixture(*CUT)
    outside = np.array([[-1.1, 0.0], [0.0, 2.1], [np.nan, 0.0], [np.inf, 0.0]])
    assert (law.log_prob(outside) == -np.inf).all()
    assert np.isfinite(law.log_prob(np.stack([law.low, law.high]))).all()


@pytest.mark.parametrize("case", [WIDE, CUT, TAIL])
def test_samples_follow_the_integrated_density(case):
    law = random_mixture(*case)
    n = 100_000
    x = law.sample(n, np.random.default_rng(5))
    bins = 40
    nodes = 12
    t, w = np.polynomial.legendre.leggauss(nodes)
    edges = [np.linspace(law.low[j], law.high[j], bins + 1) for j in range(2)]
    half = [0.5 * np.diff(e)[0] for e in edges]
    axes = [(e[:-1, None] + h * (t + 1.0)).ravel() for e, h in zip(edges, half, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    density = np.exp(law.log_prob(points)).reshape(bins, nodes, bins, nodes)
    expected = n * half[0] * half[1] * np.einsum("aibj,i,j->ab", density, w, w).ravel()
    counts = np.histogram2d(*x.T, bins=edges)[0].ravel()
    large = expected >= 10.0
    rest = (n - counts[large].sum(), n - expected[large].sum())
    terms = (counts[large] - expected[large]) ** 2 / expected[large]
    statistic = terms.sum() + (rest[0] - rest[1]) ** 2 / max(rest[1], 1.0)
    assert stats.chi2.sf(statistic, large.sum()) > 1e-4


@pytest.mark.parametrize(("scenario", "base"), SHIPPED)
def test_mapped_samples_are_standard_normal(scenario, base):
    law = load_base(scenario_named(scenario), base)
    n = 50_000
    u = law.to_standard_normal(law.sample(n, np.random.default_rng(7)))
    tests = law.dim * len(SHIPPED)
    for column in u.T:
        assert stats.kstest(column, "norm").pvalue > 1e-3 / tests
    # Correlations of u, of |u| and across the two: each is 0 with standard error 1 / sqrt(n),
    # where two different columns are compared.
    both = np.concatenate([u, np.abs(u)], axis=1)
    other = np.tile(~np.eye(law.dim, dtype=bool), (2, 2))
    correlation = np.corrcoef(both.T)[other]
    assert np.abs(correlation).max() < stats.norm.isf(1e-4 / correlation.size) / np.sqrt(n)


@pytest.mark.parametrize("case", CASES)
def test_mapped_normals_follow_the_samples(case):
    law = random_mixture(*case)
    rng = np.random.default_rng(3)
    mapped = law.from_standard_normal(rng.standard_normal((20_000, law.dim)))
    drawn = law.sample(20_000, rng)
    directions = np.concatenate([np.eye(law.dim), np.ones((1, law.dim))])
    for direction in directions:
        assert stats.ks_2samp(mapped @ direction, drawn @ direction).pvalue > 1e-4


@pytest.mark.parametrize(("scenario", "base"), SHIPPED)
def test_round_trips_of_shipped_bases(scenario, base):
    """Typical points, and each coordinate in turn out to 5 standard deviations."""
    law = load_base(scenario_named(scenario), base)
    rng = np.random.default_rng(8)
    u = rng.standard_normal((20_000, law.dim))
    column = rng.integers(0, law.dim, 10_000)
    u[np.arange(10_000), column] = rng.uniform(-5.0, 5.0, 10_000)
    x = law.from_standard_normal(u)
    assert ((x > law.low) & (x < law.high)).all()
    assert np.abs(law.to_standard_normal(x) - u).max() < 1e-8
    drawn = law.sample(20_000, rng)
    again = law.from_standard_normal(law.to_standard_normal(drawn))
    assert np.abs(again - drawn).max() < 1e-8


def of_coordinates(law):
    """The mixture of the coordinates, plain or logarithms, in their box."""
    if isinstance(law, TruncatedGaussianMixture):
        return law
    low, high = law.coordinates.to_coordinates(np.stack([law.low, law.high]))
    return TruncatedGaussianMixture(law.weights, law.means, law.covariances, low, high)


LAWS = [pytest.param(random_mixture(*case), id=f"random-{case[0]}") for case in CASES]
SHIPPED_LAWS = [unwrap(load_base(scenario_named(name), base)) for name, base in SHIPPED]
LAWS += [
    # the floats of a mixture with logarithms are those of its logarithms
    pytest.param(of_coordinates(law), id="-".join(pair))
    for law, pair in zip(SHIPPED_LAWS, SHIPPED, strict=True)
]


@pytest.mark.parametrize("law", LAWS)
def test_round_trips_to_the_float_spacing(law):
    """In the corners, where a face cuts the bulk, floats of x are further apart in u than 1e-8."""
    u = np.random.default_rng(8).uniform(-6.0, 6.0, (5000, law.dim))
    x = law.from_standard_normal(u)
    error = np.abs(law.to_standard_normal(x) - u)
    for j in range(law.dim):
        beside = x.copy()
        beside[:, j] = np.nextafter(x[:, j], 0.5 * (law.low[j] + law.high[j]))
        spacing = np.abs(law.to_standard_normal(beside) - law.to_standard_normal(x))[:, j]
        assert (error[:, j] <= 1e-8 + 2.0 * spacing).all()
        assert np.median(error[:, j]) < 1e-11


def test_far_tails_stay_in_the_box_and_in_order():
    for case in CASES:
        law = random_mixture(*case)
        corners = np.array(list(itertools.product([-9.0, 9.0], repeat=law.dim)))
        x = law.from_standard_normal(corners)
        assert ((x > law.low) & (x < law.high)).all()
        assert np.isfinite(law.log_prob(x)).all()
        assert np.isfinite(law.to_standard_normal(x)).all()
        line = np.zeros((4000, law.dim))
        line[:, 0] = np.linspace(-9.0, 9.0, len(line))
        assert (np.diff(law.from_standard_normal(line)[:, 0]) >= 0).all()


def test_one_gaussian_far_from_its_box_is_affine():
    covariance = np.array([[4.0, 1.2], [1.2, 1.0]])
    law = TruncatedGaussianMixture([1.0], [[10.0, -3.0]], [covariance], [-90.0, -53.0], [110.0, 47])
    u = np.random.default_rng(0).uniform(-9.0, 9.0, (1000, 2))
    expected = [10.0, -3.0] + u @ np.linalg.cholesky(covariance).T
    np.testing.assert_allclose(law.from_standard_normal(u), expected, atol=1e-12)
    np.testing.assert_allclose(law.to_standard_normal(expected), u, atol=1e-12)


def test_tail_of_a_tail_agrees_with_survival_functions():
    """A box 30 standard deviations out: lower tail from log survival functions."""
    law = TruncatedGaussianMixture([1.0], [[0.0]], [[[1.0]]], [30.0], [31.0])
    x = np.linspace(30.001, 30.999, 200)[:, None]
    log_sf = stats.norm.logsf(np.concatenate([[30.0, 31.0], x[:, 0]]))
    total = np.log1p(-np.exp(log_sf[1] - log_sf[0]))
    upper = log_sf[2:] - log_sf[0] + np.log1p(-np.exp(log_sf[1] - log_sf[2:])) - total
    np.testing.assert_allclose(law.to_standard_normal(x)[:, 0], -ndtri_exp(upper), atol=1e-9)


def test_mirror_image():
    law = random_mixture(*CUT_3D)
    mirror = TruncatedGaussianMixture(law.weights, -law.means, law.covariances, -law.high, -law.low)
    u = np.random.default_rng(4).uniform(-8.0, 8.0, (2000, 3))
    np.testing.assert_allclose(mirror.from_standard_normal(-u), -law.from_standard_normal(u), atol=1e-12)


def test_points_on_a_face_have_finite_images():
    law = random_mixture(*CUT)
    for each in (law, random_mixture(*ONE_3D)):
        assert np.isfinite(each.to_standard_normal(np.stack([each.low, each.high]))).all()
    u = law.to_standard_normal(np.stack([law.low, law.high]))
    assert (u[0] < -6.0).all()
    assert (u[1] > 6.0).all()


@pytest.mark.parametrize("case", CASES)
def test_rows_stand_alone_bit_for_bit(case):
    law = random_mixture(*case)
    rng = np.random.default_rng(2)
    u = np.concatenate([rng.standard_normal((1000, law.dim)), rng.uniform(-9, 9, (50, law.dim))])
    x = law.from_standard_normal(u)
    operations = [(law.from_standard_normal, u), (law.to_standard_normal, x), (law.log_prob, x)]
    order = rng.permutation(len(u))
    for function, points in operations:
        whole = function(points)
        assert (function(points[order]) == whole[order]).all()
        assert (function(points[333:]) == whole[333:]).all()
        single = np.concatenate([function(points[i : i + 1]) for i in range(0, len(u), 50)])
        assert (single == whole[::50]).all()
        assert (function(np.asfortranarray(points)) == whole).all()


def test_sample_is_seeded_and_its_first_rows_do_not_depend_on_n():
    law = random_mixture(*CUT_3D)
    long = law.sample(CHUNK_ROWS + 100, np.random.default_rng(1))
    assert (long[:50] == law.sample(50, np.random.default_rng(1))).all()
    assert not (long[:50] == law.sample(50, np.random.default_rng(2))).any()
    assert ((long > law.low) & (long < law.high)).all()


def test_no_rows_and_one_row():
    law = random_mixture(*CUT_3D)
    rng = np.random.default_rng(0)
    for n in (0, 1):
        x = law.sample(n, rng)
        assert x.shape == (n, 3)
        assert law.log_prob(x).shape == (n,)
        assert law.from_standard_normal(law.to_standard_normal(x)).shape == (n, 3)


def test_json_round_trip_is_exact():
    law = random_mixture(*MANY)
    copy = TruncatedGaussianMixture.from_dict(json.loads(json.dumps(law.to_dict())))
    x = law.sample(100, np.random.default_rng(0))
    assert copy.to_dict() == law.to_dict()
    assert (copy.log_prob(x) == law.log_prob(x)).all()


def test_parameters_are_copied_and_read_only():
    weights = np.array([1.0])
    law = TruncatedGaussianMixture(weights, [[0.0]], [[[1.0]]], [-1.0], [1.0])
    weights[0] = 2.0
    assert law.weights[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        law.means[0, 0] = 3.0


GOOD = {
    "weights": [0.5, 0.5],
    "means": [[0.0, 0.0], [1.0, 1.0]],
    "covariances": [np.eye(2).tolist()] * 2,
    "low": [-1.0, -1.0],
    "high": [2.0, 2.0],
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": [0.5, 0.6]}, r"weights must sum to 1, got 1\.1"),
        ({"weights": [1.5, -0.5]}, r"weights must be positive, got -0\.5"),
        ({"weights": [1.0]}, r"weights of shape \(2,\).*got \(1,\)"),
        ({"means": [0.0, 0.0]}, r"means of shape \(K, d\), got \(2,\)"),
        ({"means": "many"}, "means must be an array of numbers"),
        ({"covariances": [np.eye(3).tolist()] * 2}, r"covariances of shape \(2, 2, 2\)"),
        ({"covariances": [[[1.0, 2.0], [2.0, 1.0]]] * 2}, r"covariances\[0\] is not positive def"),
        ({"covariances": [[[1.0, 0.5], [0.0, 1.0]]] * 2}, r"covariances\[0\] is not symmetric"),
        ({"low": [-1.0, 2.0]}, r"low must be below high, got \[2, 2\] at coordinate 1"),
        ({"high": [2.0, np.inf]}, "high must be finite"),
        ({"high": [2.0]}, r"high of shape \(2,\)"),
    ],
)
def test_bad_parameters_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        TruncatedGaussianMixture(**{**GOOD, **change})


def test_missing_keys_are_named():
    with pytest.raises(ValueError, match="Missing means, high"):
        TruncatedGaussianMixture.from_dict({k: v for k, v in GOOD.items() if k not in ("means", "high")})


def test_bad_points_are_refused():
    law = TruncatedGaussianMixture(**GOOD)
    with pytest.raises(ValueError, match=r"x of shape \(n, 2\), got \(2,\); add a batch axis"):
        law.log_prob([0.0, 0.0])
    with pytest.raises(ValueError, match=r"u of shape \(n, 2\), got \(1, 3\)"):
        law.from_standard_normal(np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"x\[1, 0\] = 5 is outside the box \[-1, 2\]"):
        law.to_standard_normal([[0.0, 0.0], [5.0, 0.0]])
    with pytest.raises(ValueError, match=r"u\[0, 1\] = nan must be finite"):
        law.from_standard_normal([[0.0, np.nan]])
