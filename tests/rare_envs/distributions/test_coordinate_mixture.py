"""Mixtures in coordinates of their own, against closed forms, numerical integrals and finite differences."""

import itertools
import json
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import integrate, stats

from rare_envs.distributions.coordinates import ClosingSpeed, Coordinates
from rare_envs.distributions.mixture import CHUNK_ROWS, CoordinateMixture, TruncatedGaussianMixture

LOG = CoordinateMixture.from_dict(
    {
        "weights": [0.6, 0.4],
        "means": [[10.0, 2.5], [14.0, 3.2]],
        "covariances": [[[4.0, 0.5], [0.5, 0.4]], [[2.0, -0.3], [-0.3, 0.2]]],
        "low": [8.0, 3.0],
        "high": [18.0, 40.0],
        "coordinates": ["plain", "log"],
    }
)
FOLLOWING = CoordinateMixture.from_dict(
    {
        "names": ["ego_speed", "lead_speed", "gap"],
        "order": ["ego_speed", "gap", "lead_speed"],
        "coordinates": ["plain", {"closing_behind": "ego_speed", "gap": "gap"}, "log"],
        "low": [0.0, 0.0, 1.0],
        "high": [45.0, 45.0, 150.0],
        "weights": [0.7, 0.3],
        "means": [[13.0, 2.6, -0.05], [8.0, 2.0, 0.1]],
        "covariances": [
            [[9.0, 0.6, 0.02], [0.6, 0.2, -0.03], [0.02, -0.03, 0.1]],
            [[12.0, 1.0, 0.1], [1.0, 0.3, 0.02], [0.1, 0.02, 0.3]],
        ],
    }
)
"""Like the fit to recorded pairs; the slower component is cut where a speed would be negative."""
CUT = CoordinateMixture.from_dict(
    {
        **FOLLOWING.to_dict(),
        "low": [8.0, 8.0, 5.0],
        "high": [16.0, 16.0, 40.0],
        "covariances": np.multiply(FOLLOWING.covariances, 1.5).tolist(),
    }
)
"""The box cuts every coordinate in its bulk."""
CUT_IN_NAMES = ["ego_speed", "cut_in_speed", "lead_speed", "cut_in_gap", "lead_gap", "lateral_offset"]
CUT_IN_ORDER = ["ego_speed", "cut_in_gap", "cut_in_speed", "lead_gap", "lead_speed", "lateral_offset"]


def make_cut_in(seed: int, components: int) -> CoordinateMixture:
    """A cut-in with two gaps; the lead's closing speed is relative to the vehicle that cuts in."""
    rng = np.random.default_rng(seed)
    scale = np.array([2.5, 0.65, 0.5, 0.8, 0.5, 0.4])
    roots = 0.3 * rng.standard_normal((components, 6, 6)) + np.eye(6)
    covariances = roots @ roots.transpose(0, 2, 1) * np.outer(scale, scale)
    means = np.array([14.0, 2.8, -0.2, 2.5, -0.1, 3.0]) + scale * rng.uniform(-1.0, 1.0, (components, 6))
    return CoordinateMixture.from_dict(
        {
            "names": CUT_IN_NAMES,
            "order": CUT_IN_ORDER,
            "coordinates": [
                "plain",
                {"closing_behind": "ego_speed", "gap": "cut_in_gap"},
                {"closing_behind": "cut_in_speed", "gap": "lead_gap"},
                "log",
                "log",
                "plain",
            ],
            "low": [0.0, 0.0, 0.0, 1.0, 1.0, 2.2],
            "high": [45.0, 45.0, 45.0, 120.0, 150.0, 5.0],
            "weights": rng.dirichlet(np.full(components, 3.0)).tolist(),
            "means": means.tolist(),
            "covariances": covariances.tolist(),
        }
    )


CUT_IN = make_cut_in(1, 1)
CUT_IN_3 = make_cut_in(2, 3)
ALL = [
    pytest.param(each, id=name)
    for name, each in {"log": LOG, "following": FOLLOWING, "cut": CUT, "cut_in": CUT_IN, "cut_in_3": CUT_IN_3}.items()
]


def draw(distribution: CoordinateMixture, n: int, seed: int) -> NDArray[np.float64]:
    return distribution.sample(n, np.random.default_rng(seed))


# --- density ----------------------------------------------------------------------------------


def one(low: float, high: float) -> CoordinateMixture:
    """A log-normal: log x ~ N(2.5, 0.7^2)."""
    row = {"weights": [1.0], "means": [[2.5]], "covariances": [[[0.49]]], "low": [low], "high": [high]}
    return CoordinateMixture.from_dict({**row, "coordinates": ["log"]})


def test_one_logarithm_is_scipys_truncated_log_normal() -> None:
    low, high = 5.0, 60.0
    own, reference = one(low, high), stats.lognorm(0.7, scale=np.exp(2.5))
    mass = reference.cdf(high) - reference.cdf(low)
    x = np.linspace(5.01, 59.9, 50)
    np.testing.assert_allclose(own.log_prob(x[:, None]), reference.logpdf(x) - np.log(mass), rtol=1e-12)
    u = stats.norm.ppf((reference.cdf(x) - reference.cdf(low)) / mass)
    np.testing.assert_allclose(own.to_standard_normal(x[:, None])[:, 0], u, atol=1e-10)
    draws = draw(own, 20_000, 0)[:, 0]
    assert stats.kstest(draws, lambda t: (reference.cdf(t) - reference.cdf(low)) / mass).pvalue > 1e-4


def truncated(mean: Any, deviation: float, low: Any, high: Any) -> Any:
    return stats.truncnorm((low - mean) / deviation, (high - mean) / deviation, mean, deviation)


def test_one_component_of_closing_speeds_by_scipys_truncated_normals() -> None:
    """Independent coordinates: v, log gap and (v - v_lead) / sqrt(gap), the last within the lead's [0, 45] m/s."""
    mixture = CoordinateMixture(FOLLOWING.coordinates, [1.0], [[12.0, 2.5, 0.2]], [np.diag([9.0, 0.25, 0.49])])
    rng = np.random.default_rng(0)
    v, gap, lead = rng.uniform(0.1, 44.0, 200), rng.uniform(1.1, 149.0, 200), rng.uniform(0.1, 44.0, 200)
    y, root = (v - lead) / np.sqrt(gap), np.sqrt(gap)
    closing = truncated(0.2, 0.7, (v - 45.0) / root, v / root)
    expected = truncated(12.0, 3.0, 0.0, 45.0).logpdf(v) + closing.logpdf(y) - 0.5 * np.log(gap)
    expected += truncated(2.5, 0.5, 0.0, np.log(150.0)).logpdf(np.log(gap)) - np.log(gap)
    x = np.stack([v, lead, gap], axis=1)
    np.testing.assert_allclose(mixture.log_prob(x), expected, rtol=1e-9)


def test_density_of_logarithms_integrates_to_one() -> None:
    total, error = integrate.dblquad(
        lambda b, a: float(np.exp(LOG.log_prob(np.array([[a, b]])))[0]), 8.0, 18.0, 3.0, 40.0, epsabs=1e-7
    )
    assert total == pytest.approx(1.0, abs=max(1e-6, error))
    assert (LOG.log_prob(np.array([[9.0, 2.99], [9.0, 40.1], [7.9, 5.0]])) == -np.inf).all()


def test_density_of_closing_speeds_integrates_to_one() -> None:
    t, w = np.polynomial.legendre.leggauss(60)
    half = 0.5 * (CUT.high - CUT.low)
    axes = CUT.low + half * (t[:, None] + 1.0)
    points = np.array(list(itertools.product(*axes.T)))
    weights = np.einsum("i,j,k->ijk", w, w, w).ravel() * half.prod()
    assert np.exp(CUT.log_prob(points)) @ weights == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("components", [1, 3])
def test_density_of_two_closing_speeds_integrates_to_one_by_importance_sampling(components: int) -> None:
    """Draws of the untruncated mixture, put together by hand; within 4 standard errors of at most 0.005."""
    mixture, rng, n = make_cut_in(components, components), np.random.default_rng(11), 100_000
    counts = rng.multinomial(n, mixture.weights)
    normals = [stats.multivariate_normal(m, c) for m, c in zip(mixture.means, mixture.covariances, strict=True)]
    y = np.concatenate([normal.rvs(k, rng) for normal, k in zip(normals, counts, strict=True)])
    density = sum(w * normal.pdf(y) for w, normal in zip(mixture.weights, normals, strict=True))
    gap, lead_gap = np.exp(y[:, 1]), np.exp(y[:, 3])
    cutter = y[:, 0] - y[:, 2] * np.sqrt(gap)
    lead = cutter - y[:, 4] * np.sqrt(lead_gap)
    x = np.stack([y[:, 0], cutter, lead, gap, lead_gap, y[:, 5]], axis=1)
    ratio = np.exp(mixture.log_prob(x)) * gap**1.5 * lead_gap**1.5 / density
    error = ratio.std() / np.sqrt(n)
    assert error < 0.005
    assert abs(ratio.mean() - 1.0) < 4.0 * error


@pytest.mark.parametrize("mixture", ALL)
def test_density_is_that_of_normals_through_the_map(mixture: CoordinateMixture) -> None:
    """log p(x) = log phi(u) + log |det du/dx|, with central differences of the map."""
    x = mixture.from_standard_normal(np.random.default_rng(3).standard_normal((300, mixture.dim)))
    margin = 0.005 * (mixture.high - mixture.low)  # differences over 1e-5 are rough where u runs to infinity
    x = x[((x > mixture.low + margin) & (x < mixture.high - margin)).all(axis=1)]
    assert len(x) > 150
    jacobian = np.empty((len(x), mixture.dim, mixture.dim))
    for j in range(mixture.dim):
        step = np.zeros(mixture.dim)
        step[j] = 1e-5
        jacobian[:, :, j] = (mixture.to_standard_normal(x + step) - mixture.to_standard_normal(x - step)) / 2e-5
    u = mixture.to_standard_normal(x)
    expected = stats.norm.logpdf(u).sum(axis=1) + np.linalg.slogdet(jacobian)[1]
    np.testing.assert_allclose(mixture.log_prob(x), expected, atol=1e-5)


def test_an_order_of_plain_coordinates_changes_nothing_where_the_box_does_not_cut() -> None:
    covariance = [[4.0, 1.0, -0.5], [1.0, 2.0, 0.3], [-0.5, 0.3, 1.0]]
    box = {"low": [-20.0] * 3, "high": [20.0] * 3, "weights": [1.0]}
    plain = TruncatedGaussianMixture.from_dict({**box, "means": [[0.0, 1.0, 2.0]], "covariances": [covariance]})
    at = [2, 0, 1]
    other = CoordinateMixture.from_dict(
        {
            **box,
            "names": ["a", "b", "c"],
            "order": ["c", "a", "b"],
            "means": plain.means[:, at],
            "covariances": plain.covariances[:, at][:, :, at],
        }
    )
    x = plain.sample(1000, np.random.default_rng(0))
    np.testing.assert_allclose(other.log_prob(x), plain.log_prob(x), atol=1e-9)
    for j in range(3):
        assert stats.ks_2samp(draw(other, 20_000, 1)[:, j], draw(plain, 20_000, 2)[:, j]).pvalue > 1e-4


# --- samples and maps -------------------------------------------------------------------------------


@pytest.mark.parametrize("mixture", ALL)
def test_samples_are_standard_normal_through_the_map(mixture: CoordinateMixture) -> None:
    n = 50_000
    x = draw(mixture, n, 7)
    assert ((x > mixture.low) & (x < mixture.high)).all()
    u = mixture.to_standard_normal(x)
    for column in u.T:
        assert stats.kstest(column, "norm").pvalue > 1e-3 / 25
    both = np.concatenate([u, np.abs(u)], axis=1)
    other = np.tile(~np.eye(mixture.dim, dtype=bool), (2, 2))
    correlation = np.corrcoef(both.T)[other]
    assert np.abs(correlation).max() < stats.norm.isf(1e-4 / correlation.size) / np.sqrt(n)


@pytest.mark.parametrize("mixture", ALL)
def test_mapped_normals_follow_the_samples(mixture: CoordinateMixture) -> None:
    rng = np.random.default_rng(3)
    mapped = mixture.from_standard_normal(rng.standard_normal((20_000, mixture.dim)))
    drawn = mixture.sample(20_000, rng)
    for direction in (*np.eye(mixture.dim), np.ones(mixture.dim)):
        assert stats.ks_2samp(mapped @ direction, drawn @ direction).pvalue > 1e-4


@pytest.mark.parametrize("mixture", ALL)
def test_round_trips(mixture: CoordinateMixture) -> None:
    """Typical points, and each coordinate in turn out to 6 standard deviations.

    Next to a face that cuts the bulk, four floats of the size of the box are further apart in u than 1e-8.
    """
    rng = np.random.default_rng(8)
    u = rng.standard_normal((20_000, mixture.dim))
    u[np.arange(10_000), rng.integers(0, mixture.dim, 10_000)] = rng.uniform(-6.0, 6.0, 10_000)
    x = mixture.from_standard_normal(u)
    assert ((x > mixture.low) & (x < mixture.high)).all()
    error = np.abs(mixture.to_standard_normal(x) - u)
    assert (error < 1e-8).mean() > 0.9995
    for j in range(mixture.dim):
        beside, step = x.copy(), 4.0 * np.spacing(mixture.high[j])
        beside[:, j] += np.where(x[:, j] < 0.5 * (mixture.low[j] + mixture.high[j]), step, -step)
        spacing = np.abs(mixture.to_standard_normal(beside) - mixture.to_standard_normal(x))[:, j]
        assert (error[:, j] <= np.maximum(1e-8, spacing)).all()
    drawn = draw(mixture, 20_000, 9)
    assert np.abs(mixture.from_standard_normal(mixture.to_standard_normal(drawn)) - drawn).max() < 1e-8


def test_round_trips_of_following_are_exact() -> None:
    """In a box that a base may have: typical points, and each coordinate from -6 to 6."""
    axes = np.kron(np.linspace(-6.0, 6.0, 500)[:, None], np.eye(3))
    u = np.concatenate([np.random.default_rng(8).standard_normal((10_000, 3)), axes])
    assert np.abs(FOLLOWING.to_standard_normal(FOLLOWING.from_standard_normal(u)) - u).max() < 1e-8


@pytest.mark.parametrize("mixture", ALL)
def test_u_rises_with_its_own_column(mixture: CoordinateMixture) -> None:
    x = draw(mixture, 500, 4)
    u = mixture.to_standard_normal(x)
    for j in range(mixture.dim):
        beside = x.copy()
        beside[:, j] += 0.01 * (mixture.high[j] - x[:, j])
        assert (mixture.to_standard_normal(beside)[:, j] > u[:, j]).all()


@pytest.mark.parametrize("mixture", ALL)
def test_faces_of_the_box(mixture: CoordinateMixture) -> None:
    corners = np.array(list(itertools.product(*zip(mixture.low, mixture.high, strict=True))))
    assert np.isfinite(mixture.log_prob(corners)).all()
    assert np.isfinite(mixture.to_standard_normal(corners)).all()
    middle = np.repeat(np.median(draw(mixture, 1000, 0), axis=0)[None], 2 * mixture.dim, axis=0)
    for j in range(mixture.dim):
        middle[2 * j, j], middle[2 * j + 1, j] = mixture.low[j], mixture.high[j]
    u = mixture.to_standard_normal(middle)
    for j in range(mixture.dim):
        assert u[2 * j, j] < -2.0 and u[2 * j + 1, j] > 2.0
    outside = np.concatenate([mixture.low - 1e-9 * np.eye(mixture.dim), mixture.high + 1e-9 * np.eye(mixture.dim)])
    assert (mixture.log_prob(outside) == -np.inf).all()


@pytest.mark.parametrize("mixture", ALL)
def test_far_tails_stay_in_the_box(mixture: CoordinateMixture) -> None:
    u = np.random.default_rng(5).uniform(-38.0, 38.0, (2000, mixture.dim))
    x = mixture.from_standard_normal(u)
    assert ((x > mixture.low) & (x < mixture.high)).all()
    assert np.isfinite(mixture.log_prob(x)).all()


@pytest.mark.parametrize("mixture", ALL)
def test_rows_stand_alone_bit_for_bit(mixture: CoordinateMixture) -> None:
    rng = np.random.default_rng(2)
    u = np.concatenate([rng.standard_normal((1000, mixture.dim)), rng.uniform(-9, 9, (50, mixture.dim))])
    x = mixture.from_standard_normal(u)
    order = rng.permutation(len(u))
    for function, points in [
        (mixture.from_standard_normal, u), (mixture.to_standard_normal, x), (mixture.log_prob, x)
    ]:  # fmt: skip
        whole = function(points)
        assert (function(points[order]) == whole[order]).all()
        assert (function(points[333:]) == whole[333:]).all()
        single = np.concatenate([function(points[i : i + 1]) for i in range(0, len(u), 50)])
        assert (single == whole[::50]).all()
        assert (function(np.asfortranarray(points)) == whole).all()


def test_sample_is_seeded_and_its_first_rows_do_not_depend_on_n() -> None:
    long = draw(CUT_IN_3, CHUNK_ROWS + 100, 1)
    assert (long[:50] == draw(CUT_IN_3, 50, 1)).all()
    assert not (long[:50] == draw(CUT_IN_3, 50, 2)).any()
    for n in (0, 1):
        x = draw(CUT_IN_3, n, 0)
        assert (x.shape, CUT_IN_3.log_prob(x).shape) == ((n, 6), (n,))
        assert CUT_IN_3.from_standard_normal(CUT_IN_3.to_standard_normal(x)).shape == (n, 6)


# --- dictionaries ------------------------------------------------------------------------------------


@pytest.mark.parametrize("mixture", ALL)
def test_json_round_trip_is_exact(mixture: CoordinateMixture) -> None:
    copy = CoordinateMixture.from_dict(json.loads(json.dumps(mixture.to_dict())))
    x = draw(mixture, 100, 0)
    assert copy.to_dict() == mixture.to_dict()
    assert (copy.log_prob(x) == mixture.log_prob(x)).all()


def test_older_files_have_a_list_of_logarithms() -> None:
    content = LOG.to_dict()
    del content["coordinates"]
    assert CoordinateMixture.from_dict({**content, "logarithmic": [False, True]}).to_dict() == LOG.to_dict()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": [0.5, 0.6]}, "weights must sum to 1"),
        ({"means": [[1.0, 2.0]] * 2}, r"covariances of shape \(2, 2, 2\)"),
        ({"high": [45.0, 45.0]}, r"high of shape \(3,\), one for each column, got \(2,\)"),
    ],
)
def test_bad_parameters_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CoordinateMixture.from_dict({**FOLLOWING.to_dict(), **change})


def test_a_missing_key_and_other_dimensions_are_named() -> None:
    content = FOLLOWING.to_dict()
    with pytest.raises(ValueError, match="Missing means; needed are"):
        CoordinateMixture.from_dict({key: value for key, value in content.items() if key != "means"})
    two = Coordinates([0.0, 0.0], [1.0, 1.0], ("plain", "plain"))
    with pytest.raises(ValueError, match=r"means of shape \(2, 2\), one for each column, got \(2, 3\)"):
        CoordinateMixture(two, FOLLOWING.weights, FOLLOWING.means, FOLLOWING.covariances)


def test_bad_points_are_refused() -> None:
    with pytest.raises(ValueError, match=r"x of shape \(n, 3\), got \(3,\); add a batch axis"):
        FOLLOWING.log_prob([10.0, 10.0, 20.0])
    with pytest.raises(ValueError, match=r"x\[0, 2\] = 0.5 is outside the box \[1, 150\] of coordinate 2"):
        FOLLOWING.to_standard_normal([[10.0, 10.0, 0.5]])
    with pytest.raises(ValueError, match=r"u\[0, 1\] = nan must be finite"):
        FOLLOWING.from_standard_normal([[0.0, np.nan, 0.0]])
    assert FOLLOWING.coordinates.kinds[1] == ClosingSpeed("ego_speed", "gap")
