"""Curves over thresholds: bands, layers, what is known."""

import json

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.special import ndtr, ndtri

import samplers
from samplers.analysis.curve import lowest_known_threshold
from samplers.limit_states import half_space, parabola, plateau
from samplers.sample import clopper_pearson

GRID = [-0.2, 0.0, 0.4, 1.0, 2.0, 3.0, 4.5]


def run(method="mc", beta=2.0, seed=1, **options):
    return samplers.estimate(half_space(2, beta).problem, method, seed=seed, **options)


@pytest.mark.parametrize("method", ["adss", "ce", "mc", "two-stage"])
@pytest.mark.parametrize("replicates", [1, 3])
def test_it_rises_through_the_estimate_inside_its_band(method, replicates):
    result = run(method, replicates=replicates, max_sim=6000)
    curve = result.curve(GRID)
    assert curve.p[1] == pytest.approx(result.p)
    for values in (curve.p, curve.low, curve.high):
        assert (np.diff(values) >= 0).all()
    assert ((0 <= curve.low) & (curve.low <= curve.p) & (curve.p <= curve.high) & (curve.high <= 1)).all()
    assert curve.cov[1] >= 0.99 * result.cov
    assert (curve.confidence, len(curve)) == (result.confidence, len(GRID))
    if replicates == 1:  # the t interval of three runs may be wider
        assert np.log(curve.high[1] / curve.low[1]) > 0.9 * np.log(result.interval[1] / result.interval[0])


def test_one_threshold_of_plain_draws_has_the_exact_interval():
    result = run(max_sim=3000)
    curve = result.curve(0.0)
    assert (curve.low[0], curve.high[0]) == result.interval
    hits = np.count_nonzero(result.sample.f <= 0.7)
    other = result.curve([0.7])
    assert (other.low[0], other.high[0]) == clopper_pearson(hits, 3000, 0.95)
    assert other.ess[0] == pytest.approx(hits)


@pytest.mark.parametrize("method", ["adss", "ce"])
def test_one_threshold_has_the_interval_of_the_estimate(method):
    result = run(method, beta=3.5)
    curve = result.curve([0.0])
    assert (curve.low[0], curve.high[0]) == pytest.approx(result.interval, rel=0.01)


@pytest.mark.parametrize("method", ["mc", "ce", "adss"])
def test_too_low_a_threshold_is_refused_with_what_is_known(method):
    result = run(method, max_sim=3000)
    start = lowest_known_threshold(result.sample, 0.0)
    assert result.curve([start, 1.0]).ess[0] >= 4.99
    with pytest.raises(ValueError, match=rf"-9\.0 is too low .* known from g = {start!r} on.*gamma=-9\.0"):
        result.curve([0.0, -9.0])


def test_where_nothing_failed_the_thresholds_passed_are_known():
    result = run(beta=6.0, max_sim=1000)
    assert result.p == 0
    with pytest.raises(ValueError, match="known from"):
        result.curve([0.0])
    assert result.curve([6.0]).p[0] == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("gammas", [[], [np.nan], [np.inf], [[0.0, 1.0]]])
def test_thresholds_are_finite_numbers(gammas):
    with pytest.raises(ValueError, match="finite thresholds"):
        run(max_sim=100).curve(gammas)


def test_points_without_an_outcome_are_not_in_the_lower_end_where_they_only_bound():
    def f(x):
        return np.where(x[:, 1] > 2.0, np.nan, 2.0 - x[:, 0])

    problem = samplers.FunctionProblem(f, 2)
    bound, counted = (
        samplers.estimate(problem, "mc", seed=1, max_sim=5000, on_error=on_error) for on_error in ("bound", "failure")
    )
    curve, whole = bound.curve([0.0, 1.0]), counted.curve([0.0, 1.0])
    np.testing.assert_array_equal(curve.p, whole.p)
    np.testing.assert_array_equal(curve.high, whole.high)
    assert (curve.low < whole.low).all()
    assert bound.curve([0.0]).low[0] == pytest.approx(bound.interval[0])


def test_what_it_says_of_itself():
    curve = run("adss").curve(GRID)
    data = json.loads(json.dumps(curve.to_dict(), allow_nan=False))
    assert (data["p"], data["confidence"]) == (curve.p.tolist(), 0.95)
    assert len(str(curve).splitlines()) == len(GRID) + 1 and "95 % band" in str(curve)
    axes = curve.plot(Figure().subplots())
    assert axes.get_yscale() == "log"
    assert len(axes.lines) == len(axes.collections) == 1
    few = samplers.estimate(samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2), "mc", seed=0, max_sim=300)
    wide = few.curve(np.linspace(1.04, 4.0, 36))
    narrow = wide.high <= 10 * wide.low
    drawn = np.isfinite(wide.plot(Figure().subplots()).lines[0].get_xdata())
    np.testing.assert_array_equal(drawn, narrow)
    assert 0 < narrow.sum() < 36


PLATEAU_CAP = 0.5 + 3 * (3.5 - float(ndtri(0.6)))
FALLING, FLAT = np.linspace(-0.6, 5.5, 41), np.array([0, 0.1, 0.5, *np.arange(1.0, 11.0), 12.0])
FLAT = np.sort(np.append(FLAT, [PLATEAU_CAP - 1e-6, PLATEAU_CAP]))
FLAT_P = np.select([FLAT < 0.5, FLAT < PLATEAU_CAP], [ndtr(-3.5), ndtr((FLAT - 0.5) / 3 - 3.5)], 1.0)
CASES = [
    (half_space(2, 3.5), FALLING, ndtr(FALLING - 3.5)),
    (parabola(), FALLING, np.array([parabola(3.3 - g).p for g in FALLING])),
    (plateau(), FLAT, FLAT_P),
]


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: case[0].name)
@pytest.mark.parametrize("method", ["mc", "ce", "ss", "adss"])
def test_the_band_holds_the_whole_truth_in_nine_of_ten_runs(method, case):
    """At all thresholds known."""
    (reference, grid, exact), inside = case, 0
    for seed in range(5000, 5200):
        max_sim = 20_000 if method == "mc" else None
        result = samplers.estimate(reference.problem, method, seed=seed, max_sim=max_sim)
        known = grid >= lowest_known_threshold(result.sample, 0.0)
        curve = result.curve(grid[known])
        inside += bool(((curve.low <= exact[known]) & (exact[known] <= curve.high)).all())
    assert inside >= 180


def test_a_curve_comes_back_from_its_file(tmp_path):
    curve = run("ce", max_sim=5000).curve([1.0, 0.0])
    curve.save(tmp_path / "curve")
    found = samplers.Curve.load(tmp_path / "curve")
    for name in ("gammas", "p", "low", "high", "cov", "ess"):
        np.testing.assert_array_equal(getattr(found, name), getattr(curve, name))
    assert str(found) == str(curve)
