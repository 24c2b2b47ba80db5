"""Mixtures, plain and in coordinates of their own, against closed forms, integrals and finite differences."""

import itertools
import json
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from scipy.special import ndtri_exp

from rare_envs.distributions.coordinates import ClosingSpeed, Coordinates
from rare_envs.distributions.mixture import CHUNK, PooledMixture, TruncatedGaussianMixture, pool_mixtures


def random_mixture(seed: int, components: int, d: int, low: float, high: float) -> TruncatedGaussianMixture:
    rng = np.random.default_rng(seed)
    roots = rng.standard_normal((components, d, d))
    covariances = roots @ roots.transpose(0, 2, 1) + 0.2 * np.eye(d)
    means = 2.0 * rng.standard_normal((components, d))
    return TruncatedGaussianMixture(rng.dirichlet(np.full(components, 3.0)), means, covariances, [low] * d, [high] * d)


def make_cut_in(seed: int, components: int) -> TruncatedGaussianMixture:
    """A cut-in with two gaps; the lead's closing speed is relative to the vehicle that cuts in."""
    rng = np.random.default_rng(seed)
    scale = np.array([2.5, 0.65, 0.5, 0.8, 0.5, 0.4])
    roots = 0.3 * rng.standard_normal((components, 6, 6)) + np.eye(6)
    covariances = roots @ roots.transpose(0, 2, 1) * np.outer(scale, scale)
    means = np.array([14.0, 2.8, -0.2, 2.5, -0.1, 3.0]) + scale * rng.uniform(-1.0, 1.0, (components, 6))
    first, second = {"closing_behind": "ego", "gap": "gap"}, {"closing_behind": "cutter", "gap": "lead_gap"}
    return TruncatedGaussianMixture.from_dict(
        {
            "names": ["ego", "cutter", "lead", "gap", "lead_gap", "offset"],
            "order": ["ego", "gap", "cutter", "lead_gap", "lead", "offset"],
            "coordinates": ["plain", first, second, "log", "log", "plain"],
            "low": [0.0, 0.0, 0.0, 1.0, 1.0, 2.2],
            "high": [45.0, 45.0, 45.0, 120.0, 150.0, 5.0],
            "weights": rng.dirichlet(np.full(components, 3.0)).tolist(),
            "means": means.tolist(),
            "covariances": covariances.tolist(),
        }
    )


FOLLOWING = TruncatedGaussianMixture.from_dict(
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
BOX = {"low": [8.0, 8.0, 5.0], "high": [16.0, 16.0, 40.0]}
CUT = TruncatedGaussianMixture.from_dict({**FOLLOWING.to_dict(), **BOX})
"""The box cuts every coordinate in its bulk."""
WIDE = random_mixture(1, 3, 2, -15.0, 15.0)
CUT_2D = random_mixture(2, 3, 2, -1.0, 2.0)
TAIL = random_mixture(3, 2, 2, 5.0, 7.0)
CUT_3D = random_mixture(4, 2, 3, -1.5, 2.5)
CUT_IN = make_cut_in(2, 3)
NAMES = ("speed", "lead_speed", "gap")
ROAD: dict[str, Any] = {"low": [0.0, 0.0, 1.0], "high": [45.0, 45.0, 150.0], "names": NAMES}
IN_ORDER = Coordinates(
    **ROAD, kinds=("plain", ClosingSpeed("speed", "gap"), "log"), order=("speed", "gap", "lead_speed")
)
LOG_GAP = Coordinates(**ROAD, kinds=("plain", "plain", "log"))
PLAIN = Coordinates(ROAD["low"], ROAD["high"], ("plain",) * 3)  # a file may leave the names of plain columns out
IN_CLOSING = TruncatedGaussianMixture([1.0], [[15.0, 3.0, 0.1]], [np.diag([4.0, 0.2, 0.1])], coordinates=IN_ORDER)
IN_LOG_GAP = TruncatedGaussianMixture(
    [0.7, 0.3],
    [[15.0, 15.0, 3.0], [25.0, 24.0, 3.5]],
    [[[4.0, 3.0, 0.2], [3.0, 4.0, 0.1], [0.2, 0.1, 0.2]], np.diag([4.0, 9.0, 0.1])],
    coordinates=LOG_GAP,
)
IN_PLAIN = TruncatedGaussianMixture([1.0], [[14.0, 14.0, 30.0]], [np.diag([9.0, 9.0, 100.0])], coordinates=PLAIN)
POOL = pool_mixtures([IN_CLOSING, IN_LOG_GAP, IN_LOG_GAP, IN_PLAIN])
"""Of different coordinates."""
plain = pytest.mark.parametrize("mixture", [WIDE, CUT_2D, TAIL, CUT_3D], ids=["wide", "cut", "tail", "cut_3d"])
every = pytest.mark.parametrize(
    "mixture",
    [CUT_2D, TAIL, CUT_3D, FOLLOWING, CUT, CUT_IN, POOL],
    ids=["2d", "tail", "3d", "following", "cut", "cut_in", "pool"],
)


def draw(mixture: TruncatedGaussianMixture, n: int, seed: int) -> NDArray[np.float64]:
    return mixture.sample(n, np.random.default_rng(seed))


def marginal(mixture: TruncatedGaussianMixture, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Density of the untruncated mixture's first x.shape[1] coordinates, by SciPy."""
    k = x.shape[1]
    parts = zip(mixture.weights, mixture.means, mixture.covariances, strict=True)
    density = [w * np.atleast_1d(stats.multivariate_normal(m[:k], c[:k, :k]).pdf(x)) for w, m, c in parts if k]
    return np.sum(density, axis=0) if k else np.ones(len(x))


@plain
def test_density_is_the_product_of_cut_conditionals(mixture: TruncatedGaussianMixture) -> None:
    """The definition: each conditional is divided by its integral over its range."""
    x = np.random.default_rng(0).uniform(mixture.low, mixture.high, (50, mixture.dim))
    t, w = np.polynomial.legendre.leggauss(400)
    density = np.ones(len(x))
    for j in range(mixture.dim):
        half = 0.5 * (mixture.high[j] - mixture.low[j])
        line = np.repeat(x[:, : j + 1], len(t), axis=0)
        line[:, j] = np.tile(mixture.low[j] + half * (t + 1.0), len(x))
        density *= marginal(mixture, x[:, : j + 1]) / (marginal(mixture, line).reshape(len(x), -1) @ (half * w))
    np.testing.assert_allclose(np.exp(mixture.log_prob(x)), density, rtol=1e-8)


def truncated(mean: Any, deviation: float, low: Any, high: Any) -> Any:
    return stats.truncnorm((low - mean) / deviation, (high - mean) / deviation, mean, deviation)


def test_one_component_of_closing_speeds_by_scipys_truncated_normals() -> None:
    """Independent coordinates: v, log gap and (v - v_lead) / sqrt(gap), the last within the lead's [0, 45] m/s."""
    mixture = TruncatedGaussianMixture(
        [1.0], [[12.0, 2.5, 0.2]], [np.diag([9.0, 0.25, 0.49])], coordinates=FOLLOWING.coordinates
    )
    rng = np.random.default_rng(0)
    v, gap, lead = rng.uniform(0.1, 44.0, 200), rng.uniform(1.1, 149.0, 200), rng.uniform(0.1, 44.0, 200)
    y, root = (v - lead) / np.sqrt(gap), np.sqrt(gap)
    closing = truncated(0.2, 0.7, (v - 45.0) / root, v / root)
    expected = truncated(12.0, 3.0, 0.0, 45.0).logpdf(v) + closing.logpdf(y) - 0.5 * np.log(gap)
    expected += truncated(2.5, 0.5, 0.0, np.log(150.0)).logpdf(np.log(gap)) - np.log(gap)
    np.testing.assert_allclose(mixture.log_prob(np.stack([v, lead, gap], axis=1)), expected, rtol=1e-9)


@every
def test_density_is_that_of_normals_through_the_map(mixture: TruncatedGaussianMixture) -> None:
    """log p(x) = log phi(u) + log |det du/dx|, with central differences of the map."""
    x = mixture.from_standard_normal(np.random.default_rng(3).standard_normal((300, mixture.dim)))
    margin = 0.005 * (mixture.high - mixture.low)  # differences over 1e-5 are rough where u runs to infinity
    x = x[((x > mixture.low + margin) & (x < mixture.high - margin)).all(axis=1)]
    assert len(x) > 150
    steps = 1e-5 * np.eye(mixture.dim)
    change = [mixture.to_standard_normal(x + step) - mixture.to_standard_normal(x - step) for step in steps]
    u = mixture.to_standard_normal(x)
    expected = stats.norm.logpdf(u).sum(axis=1) + np.linalg.slogdet(np.stack(change, axis=2) / 2e-5)[1]
    np.testing.assert_allclose(mixture.log_prob(x), expected, atol=1e-5)


def check_normal(u: NDArray[np.float64]) -> None:
    """Columns are standard normal and uncorrelated, also their absolute values, at a level of about 1e-4."""
    for column in u.T:
        assert stats.kstest(column, "norm").pvalue > 1e-5
    both = np.concatenate([u, np.abs(u)], axis=1)
    correlation = np.corrcoef(both.T)[np.tile(~np.eye(u.shape[1], dtype=bool), (2, 2))]
    assert np.abs(correlation).max() < stats.norm.isf(1e-5 / correlation.size) / np.sqrt(len(u))


@every
def test_samples_are_standard_normal_through_the_map(mixture: TruncatedGaussianMixture) -> None:
    x = draw(mixture, 20_000, 7)
    assert ((x > mixture.low) & (x < mixture.high)).all()
    check_normal(mixture.to_standard_normal(x))


@every
def test_round_trips_to_the_spacing_of_floats(mixture: TruncatedGaussianMixture) -> None:
    """Next to a face that cuts the bulk, floats of the size of the box are further apart in u than 1e-8."""
    rng = np.random.default_rng(8)
    u = rng.standard_normal((3000, mixture.dim))
    u[np.arange(1500), rng.integers(0, mixture.dim, 1500)] = rng.uniform(-6.0, 6.0, 1500)
    x = mixture.from_standard_normal(u)
    assert ((x > mixture.low) & (x < mixture.high)).all()
    error = np.abs(mixture.to_standard_normal(x) - u)
    assert np.median(error) < 1e-10
    for j in range(mixture.dim):
        beside, step = x.copy(), 4.0 * np.spacing(mixture.high[j])
        beside[:, j] += np.where(x[:, j] < 0.5 * (mixture.low[j] + mixture.high[j]), step, -step)
        spacing = np.abs(mixture.to_standard_normal(beside) - mixture.to_standard_normal(x))[:, j]
        assert (error[:, j] <= np.maximum(1e-8, spacing)).all()
    drawn = draw(mixture, 2000, 9)
    assert np.abs(mixture.from_standard_normal(mixture.to_standard_normal(drawn)) - drawn).max() < 1e-8


@every
def test_u_rises_with_its_own_column_and_faces_and_far_tails_are_finite(mixture: TruncatedGaussianMixture) -> None:
    x = draw(mixture, 300, 4)
    u = mixture.to_standard_normal(x)
    for j in range(mixture.dim):
        beside = x.copy()
        beside[:, j] += 0.01 * (mixture.high[j] - x[:, j])
        assert (mixture.to_standard_normal(beside)[:, j] > u[:, j]).all()
    corners = np.array(list(itertools.product(*zip(mixture.low, mixture.high, strict=True))))
    assert np.isfinite(mixture.log_prob(corners)).all()
    assert np.isfinite(mixture.to_standard_normal(corners)).all()
    outside = np.concatenate([mixture.low - 1e-9 * np.eye(mixture.dim), mixture.high + 1e-9 * np.eye(mixture.dim)])
    assert (mixture.log_prob(outside) == -np.inf).all()
    x = mixture.from_standard_normal(np.random.default_rng(5).uniform(-38.0, 38.0, (10, mixture.dim)))
    assert ((x > mixture.low) & (x < mixture.high)).all()
    assert np.isfinite(mixture.log_prob(x)).all()


def test_tail_of_a_tail_agrees_with_survival_functions() -> None:
    """A box 30 standard deviations out: lower tail from log survival functions."""
    mixture = TruncatedGaussianMixture([1.0], [[0.0]], [[[1.0]]], [30.0], [31.0])
    x = np.linspace(30.001, 30.999, 200)[:, None]
    log_sf = stats.norm.logsf(np.concatenate([[30.0, 31.0], x[:, 0]]))
    total = np.log1p(-np.exp(log_sf[1] - log_sf[0]))
    upper = log_sf[2:] - log_sf[0] + np.log1p(-np.exp(log_sf[1] - log_sf[2:])) - total
    np.testing.assert_allclose(mixture.to_standard_normal(x)[:, 0], -ndtri_exp(upper), atol=1e-9)
    np.testing.assert_allclose(mixture.from_standard_normal(mixture.to_standard_normal(x)), x, atol=1e-9)


def test_an_order_of_columns_is_the_mixture_with_columns_exchanged() -> None:
    """The mixture's arrays are in the order (b, a); columns of x and u stay where they are."""
    box = Coordinates([-1.0, -1.0], [2.0, 2.0], ("plain", "plain"), names=("a", "b"), order=("b", "a"))
    exchanged = TruncatedGaussianMixture(CUT_2D.weights, CUT_2D.means, CUT_2D.covariances, coordinates=box)
    u = np.random.default_rng(0).standard_normal((100, 2))
    x = exchanged.from_standard_normal(u)
    assert (x[:, ::-1] == CUT_2D.from_standard_normal(u[:, ::-1])).all()
    assert (exchanged.log_prob(x) == CUT_2D.log_prob(x[:, ::-1])).all()
    assert (draw(exchanged, 100, 1)[:, ::-1] == draw(CUT_2D, 100, 1)).all()


@every
def test_rows_stand_alone_bit_for_bit(mixture: TruncatedGaussianMixture) -> None:
    rng = np.random.default_rng(2)
    u = np.concatenate([rng.standard_normal((500, mixture.dim)), rng.uniform(-9, 9, (50, mixture.dim))])
    x = mixture.from_standard_normal(u)
    order = rng.permutation(len(u))
    for function, points in [
        (mixture.from_standard_normal, u), (mixture.to_standard_normal, x), (mixture.log_prob, x)
    ]:  # fmt: skip
        whole = function(points)
        assert (function(points[order]) == whole[order]).all()
        single = np.concatenate([function(points[i : i + 1]) for i in range(0, len(u), 50)])
        assert (single == whole[::50]).all()
        assert (function(np.asfortranarray(points)) == whole).all()


def test_draws_are_seeded_and_neither_their_number_nor_chunks_show() -> None:
    rows = CHUNK // 3  # of 3 components
    long = draw(CUT_IN, rows + 100, 1)
    assert (long[:50] == draw(CUT_IN, 50, 1)).all()
    assert not (long[:50] == draw(CUT_IN, 50, 2)).any()
    assert (CUT_IN.log_prob(long)[rows - 3 :] == CUT_IN.log_prob(long[rows - 3 :])).all()
    for n in (0, 1):
        x = draw(CUT_IN, n, 0)
        assert (x.shape, CUT_IN.log_prob(x).shape) == ((n, 6), (n,))
        assert CUT_IN.from_standard_normal(CUT_IN.to_standard_normal(x)).shape == (n, 6)


@pytest.mark.parametrize("mixture", [CUT_3D, FOLLOWING], ids=["plain", "closing"])
def test_json_round_trip_is_exact(mixture: TruncatedGaussianMixture) -> None:
    copy = type(mixture).from_dict(json.loads(json.dumps(mixture.to_dict())))
    x = draw(mixture, 100, 0)
    assert copy.to_dict() == mixture.to_dict()
    assert (copy.log_prob(x) == mixture.log_prob(x)).all()
    with pytest.raises(ValueError, match="read-only"):
        mixture.means[0, 0] = 3.0


def test_the_density_is_the_mean_of_the_densities() -> None:
    """Another order of the columns cuts a mixture otherwise at the box, beyond which lie 1e-3 and less of these."""
    assert isinstance(POOL, PooledMixture)
    assert POOL.shares.tolist() == [0.25, 0.5, 0.25]
    x = POOL.sample(2000, np.random.default_rng(0))
    mean = np.mean([np.exp(each.log_prob(x)) for each in (IN_CLOSING, IN_LOG_GAP, IN_LOG_GAP, IN_PLAIN)], axis=0)
    np.testing.assert_allclose(np.exp(POOL.log_prob(x)), mean, rtol=5e-3)
    assert POOL.log_prob([[50.0, 10.0, 10.0]])[0] == -np.inf


def test_pools_that_cannot_be_are_refused() -> None:
    other = TruncatedGaussianMixture([1.0], [[0.0] * 3], [np.eye(3)], [-1.0] * 3, [1.0] * 3)
    with pytest.raises(ValueError, match="same box, but mixtures 0 and 1 differ"):
        pool_mixtures([IN_CLOSING, other])
    backward = Coordinates(**ROAD, kinds=(ClosingSpeed("lead_speed", "gap"), "plain", "log"), order=NAMES[::-1])
    against = TruncatedGaussianMixture([1.0], [[3.0, 15.0, 0.1]], [np.diag([0.2, 4.0, 0.1])], coordinates=backward)
    with pytest.raises(ValueError, match="No order of the columns serves the coordinates of all mixtures"):
        pool_mixtures([IN_CLOSING, against])


GOOD: dict[str, Any] = {
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
        ({"means": "many"}, "means must be an array of numbers"),
        ({"covariances": [np.eye(3).tolist()] * 2}, r"covariances of shape \(2, 2, 2\)"),
        ({"covariances": [[[1.0, 2.0], [2.0, 1.0]]] * 2}, r"covariances\[0\] is not positive def"),
        ({"covariances": [[[1.0, 0.5], [0.0, 1.0]]] * 2}, r"covariances\[0\] is not symmetric"),
        ({"high": [2.0, np.inf]}, "high must be finite"),
    ],
)
def test_bad_parameters_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TruncatedGaussianMixture(**{**GOOD, **change})


def test_missing_keys_and_other_dimensions_are_named() -> None:
    with pytest.raises(ValueError, match="Missing means, high"):
        TruncatedGaussianMixture.from_dict({k: v for k, v in GOOD.items() if k not in ("means", "high")})
    two = Coordinates([0.0, 0.0], [1.0, 1.0], ("plain", "plain"))
    with pytest.raises(ValueError, match=r"means of shape \(2, 2\), one for each column, got \(2, 3\)"):
        TruncatedGaussianMixture(FOLLOWING.weights, FOLLOWING.means, FOLLOWING.covariances, coordinates=two)


@pytest.mark.parametrize("mean", [[20.0, 25.0], [44.0, 44.5]])
def test_density_and_draws_with_a_difference_agree_where_its_range_vanishes(mean: list[float]) -> None:
    """A lead that brakes by loss keeps 1 m/s or more: the density adds up to 1 also with its mass at the edge."""
    made = {"low": [0.0, 0.0], "high": [45.0, 45.0], "names": ("loss", "speed"), "order": ("loss", "speed")}
    braking = Coordinates(**made, within=(("speed", "loss", 1.0, 45.0),))
    mixture = TruncatedGaussianMixture([1.0], [mean], [np.diag([9.0, 9.0])], coordinates=braking)
    middles = (np.arange(1000) + 0.5) * 0.045
    points = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)
    assert np.exp(mixture.log_prob(points)).sum() * 0.045**2 == pytest.approx(1.0, abs=0.02)
    x = mixture.sample(2000, np.random.default_rng(0))
    assert np.isfinite(mixture.log_prob(x)).all() and np.isfinite(mixture.to_standard_normal(x)).all()
    with pytest.raises(ValueError, match=r"x\[0, 0\] = 43.9 is outside the range \[0, 43.56\]"):
        mixture.to_standard_normal([[43.9, 44.95]])
    with pytest.raises(ValueError, match=r"within leaves loss no range: from 9\.95 to 9\.9"):
        Coordinates(**{**made, "low": [9.95, 0.0], "high": [20.0, 10.0]}, within=(("speed", "loss", 0.0, 10.0),))


def make_queue(seed: int, names: tuple[str, ...]) -> TruncatedGaussianMixture:
    """Return an ego, a cutter beside it (5 m long) and the ego's lead, which leaves 1 m and room to brake at 7.6 m/s^2.

    In many of the draws that are not cut the lead would be inside the ego, or be run into.
    """
    rng = np.random.default_rng(seed)
    room = ("lead_gap", "cut_in_gap", "ego_speed", "lead_speed", -4.0, 7.6)
    coordinates = Coordinates(
        low=[0.0, 0.0, -10.0, 1.0][: len(names)],
        high=[45.0, 45.0, 120.0, 150.0][: len(names)],
        kinds=("plain", "plain", "plain", "log")[: len(names)],
        names=names,
        within=(room,) if "lead_gap" in names else (),
    )
    d = len(names)
    roots = np.linalg.qr(rng.standard_normal((2, 4, 4)))[0][:, :d] * 2.0
    covariances = roots @ roots.transpose(0, 2, 1) + np.diag([9.0, 9.0, 4.0, 0.4][:d])
    return TruncatedGaussianMixture(
        [0.6, 0.4], [[m, 14.0, -6.0, 1.5][:d] for m in (16.0, 20.0)], covariances, coordinates=coordinates
    )


QUEUE_NAMES = ("ego_speed", "lead_speed", "cut_in_gap", "lead_gap")


def test_room_to_brake_cuts_the_law_where_the_lead_would_be_in_the_ego() -> None:
    """The density over the gap adds up to that of the other columns; maps are exact; draws are of the law."""
    queue = make_queue(5, QUEUE_NAMES)
    x = queue.sample(20_000, np.random.default_rng(0))
    closing, room = np.maximum(x[:, 0] - x[:, 1], 0.0), x[:, 2] + 5.0 + x[:, 3]
    assert (room >= 1.0 + closing**2 / 15.2 - 1e-9).all() and (room < 2.0).any()
    u = queue.to_standard_normal(x)
    assert min(stats.kstest(u[:, j], "norm").pvalue for j in range(4)) > 1e-4
    assert np.abs(np.corrcoef(u.T) - np.eye(4)).max() < 4.5 / np.sqrt(len(u))
    other = queue.from_standard_normal(np.random.default_rng(1).standard_normal((20_000, 4)))
    assert min(stats.ks_2samp(x[:, j], other[:, j]).pvalue for j in range(4)) > 1e-4
    far = np.clip(2.5 * np.random.default_rng(2).standard_normal((2000, 4)), -6.0, 6.0)
    assert np.abs(queue.to_standard_normal(queue.from_standard_normal(far)) - far).max() < 1e-7
    others = make_queue(5, QUEUE_NAMES[:3])
    nodes, weights = np.polynomial.legendre.leggauss(400)
    for row in x[:20]:
        low = max(1.0, -4.0 - row[2] + max(row[0] - row[1], 0.0) ** 2 / 15.2)
        log_gap = 0.5 * (np.log(150.0) + np.log(low) + (np.log(150.0) - np.log(low)) * nodes)
        gaps = np.exp(log_gap)
        density = np.exp(queue.log_prob(np.column_stack([np.tile(row[:3], (400, 1)), gaps]))) * gaps
        mass = 0.5 * (np.log(150.0) - np.log(low)) * (density @ weights)
        assert mass == pytest.approx(np.exp(others.log_prob(row[None, :3]))[0], rel=1e-6)
    overlapping = [[16.0, 14.0, -8.0, 1.5]]
    assert queue.log_prob(overlapping)[0] == -np.inf
    with pytest.raises(ValueError, match=r"x\[0, 3\] = 1.5 is outside the range \[4.26316, 150\]"):
        queue.to_standard_normal(overlapping)


def test_a_pool_of_other_coordinates_keeps_what_cuts_their_ranges() -> None:
    """A loss from the speed to 1 m/s above it, in plain and in log speeds: nobody loses other than that."""
    box: dict[str, Any] = {"low": [1.0, 1.0], "high": [45.0, 50.0], "names": ("speed", "loss")}
    parts = [
        TruncatedGaussianMixture(
            [1.0],
            [[mean, 25.0]],
            [np.diag([variance, 1e8])],
            coordinates=Coordinates(**box, kinds=(kind, "plain"), within=(("loss", "speed", 0.0, 1.0),)),
        )
        for kind, mean, variance in (("plain", 14.0, 9.0), ("log", 2.6, 0.05))
    ]
    pool = pool_mixtures(parts)
    assert isinstance(pool, PooledMixture)
    x = pool.sample(4000, np.random.default_rng(0))
    assert ((x[:, 1] >= x[:, 0]) & (x[:, 1] <= x[:, 0] + 1.0)).all()
    mean = np.mean([np.exp(each.log_prob(x)) for each in parts], axis=0)
    np.testing.assert_allclose(np.exp(pool.log_prob(x)), mean, rtol=1e-9)
    u = pool.to_standard_normal(x)
    assert np.abs(pool.from_standard_normal(u) - x).max() < 1e-9
    assert min(stats.kstest(u[:, j], "norm").pvalue for j in range(2)) > 1e-4


@pytest.mark.parametrize(
    ("within", "message"),
    [
        (
            ("cut_in_gap", "lead_gap", "ego_speed", "lead_speed", -4.0, 7.6),
            "after lead_gap, ego_speed, lead_speed in order",
        ),
        (("lead_gap", "cut_in_gap", "ego_speed", "lead_speed", 50.0, 7.6), "within leaves lead_gap no range: from 193"),
        (("lead_gap", "cut_in_gap", "ego_speed", "lead_speed", -4.0, -8.0), "braking > 0"),
        (("lead_gap", "cut_in_gap", "ego_speed", "lead_speed", float("nan"), 8.0), "names and numbers, got"),
        (("lead_gap", ["x"], "ego_speed", "lead_speed", -4.0, "8"), "names and numbers, got"),
        (("lead_gap", "cut_in_gap", -4.0), "each cut of within as"),
    ],
)
def test_room_that_cannot_be_is_refused(within: Any, message: str) -> None:
    own = make_queue(5, QUEUE_NAMES).coordinates
    with pytest.raises(ValueError, match=message):
        Coordinates(own.low, own.high, own.kinds, own.names, within=(within,))


def test_bad_points_are_refused() -> None:
    with pytest.raises(ValueError, match=r"x of shape \(n, 3\), got \(3,\); add a batch axis"):
        FOLLOWING.log_prob([10.0, 10.0, 20.0])
    with pytest.raises(ValueError, match=r"x\[0, 2\] = 0.5 is outside the range \[1, 150\] of coordinate 2"):
        FOLLOWING.to_standard_normal([[10.0, 10.0, 0.5]])
    with pytest.raises(ValueError, match=r"u\[0, 1\] = nan must be finite"):
        FOLLOWING.from_standard_normal([[0.0, np.nan, 0.0]])


CLOSING = {"closing_behind": "v", "gap": "gap"}
DRIVERS: dict[str, Any] = {
    "names": ["v", "lead", "gap"],
    "order": ["v", "gap", "lead"],
    "coordinates": ["plain", CLOSING, "log"],
    "low": [0.0, 5.0, 1.0],
    "high": [45.0, 40.0, 150.0],
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"coordinates": ["plain", "sqrt", "log"]}, 'coordinate \'sqrt\' of lead; known are "plain", "log" and'),
        ({"coordinates": ["plain", {**CLOSING, "gap": "space"}, "log"]}, "names no column 'space'; columns are v, lea"),
        ({"coordinates": ["plain", {**CLOSING, "gap": "lead"}, "log"]}, "lead depends on lead, which must come earl"),
        ({"order": ["v", "lead", "gap"]}, "of lead depends on gap, which must come earlier in order; order is v, lead"),
        ({"order": ["v", "gap"]}, "order must have each of the columns v, lead, gap once, got v, gap"),
        ({"names": ["v", "lead"]}, "Expected 3 different names, one for each column, got v, lead"),
        ({"coordinates": ["log"]}, r"low of shape \(1,\), one for each column, got \(3,\)"),
        ({"low": [0.0, 5.0, 0.0]}, "The coordinate of lead needs a positive low of gap, got 0"),
        ({"low": [0.0, 50.0, 1.0]}, r"low must be below high, got \[50, 40\] at coordinate 1"),
    ],
)
def test_wrong_coordinates_are_refused_in_one_line(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        Coordinates.from_dict({**DRIVERS, **change})
    assert "\n" not in str(caught.value)
