import math

import numpy as np
import pytest
from scipy import stats

from samplers.methods.two_stage.regions import (
    ChainPaths,
    Region,
    SubsetPoints,
    _add_subset_points,
    _estimate_direction,
    _is_noisy,
    _pcn_chains,
    _replicate_seeds,
    grow_regions,
    label_regions,
)
from samplers.methods.two_stage.settings import RegionSettings
from samplers.methods.two_stage.simulator import Simulator
from samplers.problem import FunctionProblem

SETTINGS = RegionSettings()


def half_spaces(dim, *betas):
    """Beyond u_k >= beta_k, one coordinate for each."""
    return FunctionProblem(lambda u: np.min([beta - u[:, k] for k, beta in enumerate(betas)], axis=0), dim)


@pytest.mark.parametrize("dim", [1, 2, 20])
@pytest.mark.parametrize("turned", [0.0, 0.5], ids=["along the axis", "off the axis"])
def test_chains_leave_the_distribution_of_failures_as_it_is(drive, dim, turned, rng):
    """From exact draws beyond a plane, with the direction given, right or wrong: still the same distribution."""
    beta, n = 2.0, 4000
    start = rng.standard_normal((n, dim))
    start[:, 0] = stats.truncnorm(beta, np.inf).rvs(n, random_state=rng)
    direction = np.eye(dim)[0] + turned * np.eye(dim)[-1]
    direction /= np.linalg.norm(direction)
    problem = half_spaces(dim, beta)
    steps = _pcn_chains(Simulator(problem), start, np.full(n, 0.5), np.tile(direction, (n, 1)), 6, 0.0, rng)
    paths = drive(steps, problem).value
    assert paths.states.shape == (n, 6, dim)
    end = paths.states[:, -1]
    assert stats.kstest(end[:, 0], stats.truncnorm(beta, np.inf).cdf).pvalue > 1e-4
    for k in range(1, min(dim, 4)):
        assert stats.kstest(end[:, k], stats.norm.cdf).pvalue > 1e-4
    moved = (np.diff(paths.states, axis=1) != 0).any(axis=2).mean()
    assert moved > 0.2


def test_chains_without_a_direction_come_from_a_wide_failure_to_likely_ones(drive, rng):
    """Started twice as far as failures are, in 20 dimensions; the step adapts to an acceptance of about a third."""
    problem = half_spaces(20, 3.0)
    start = 2.5 * rng.standard_normal((300, 20))
    start[:, 0] = 6.0
    paths = drive(_pcn_chains(Simulator(problem), start, np.full(300, 0.5), None, 30, 0.0, rng), problem).value
    end = paths.states[:, -1]
    assert (end[:, 0] >= 3.0).all()
    assert end[:, 0].mean() < 3.7
    assert (end[:, 1:] ** 2).mean() < 1.5  # 6.25 at the start
    assert 0.2 < (paths.f[:, 10:] <= 0).mean() < 0.5


def test_regions_are_told_apart_by_the_point_half_way(drive, rng):
    problem = half_spaces(4, 2.5, 2.5, 2.5)
    u = np.concatenate([rng.normal(0, 0.1, (20, 4)) + 3.0 * np.eye(4)[k] for k in range(3)])
    labels, scattered = drive(label_regions(Simulator(problem), u, 0.0, 10**6), problem).value
    assert not scattered
    assert labels.shape == (60,)
    assert all(len(set(labels[20 * k : 20 * (k + 1)])) == 1 for k in range(3))
    assert set(labels) == {0, 1, 2}


def test_a_far_point_and_one_in_two_regions_join_no_regions(drive, rng):
    """Half way from (8, 0) to (0, 3) lies within the first region; (4, 4) is in both."""
    problem = half_spaces(2, 3.0, 3.0)
    u = np.array([[8.0, 0.0], [4.0, 4.0], [3.1, 0.0], [0.0, 3.2], [3.3, 0.5], [-0.5, 3.1]])
    for order in [rng.permutation(6) for _ in range(20)]:
        labels, _ = drive(label_regions(Simulator(problem), u[order], 0.0, 10**6), problem).value
        found = labels[np.argsort(order)]
        assert found[2] == found[4] != found[3] == found[5]


@pytest.mark.parametrize("dim", [6, 10])
def test_more_regions_than_a_shell_would_need_are_pieces_of_it(drive, dim):
    """The faces of a cube: 12 regions leave few points unsorted after the first eight, 20 leave most of them."""
    problem = FunctionProblem(lambda u: 3.0 - np.abs(u).max(axis=1), dim)
    u = np.concatenate([s * 3.3 * np.eye(dim) for s in (1, -1)])
    per_face = np.repeat([6, 1], [8, 4]) if dim == 6 else np.full(20, 3)
    labels, scattered = drive(
        label_regions(Simulator(problem), np.repeat(u, per_face, axis=0), 0.0, 10**6), problem
    ).value
    assert scattered == (dim == 10)
    assert set(labels) == set(range(12 if dim == 6 else SETTINGS.many_regions))


def test_regions_with_few_chains_get_more(rng):
    labels = np.repeat([0, 1, 2], [20, 3, 9])
    more = _replicate_seeds(labels, 10, SETTINGS.max_replicated, rng)
    np.testing.assert_array_equal(np.sort(np.unique(more)), np.arange(32))
    np.testing.assert_array_equal(np.bincount(labels[more]), [20, 10, 10])
    assert len(_replicate_seeds(np.arange(30), 24, SETTINGS.max_replicated, rng)) == 30 + SETTINGS.max_replicated


def test_the_steps_are_in_balance_at_the_acceptance_that_the_settings_say():
    """E[log factor] = 0 at a = log(1 / down) / log(up / down)."""
    for (up, down), acceptance in ((SETTINGS.across_factors, 0.75), (SETTINGS.along_factors, 0.68)):
        assert math.log(1 / down) / math.log(up / down) == pytest.approx(acceptance, abs=0.005)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_f_is_noisy_if_points_beside_failing_ones_do_not_fail(drive, rng, share):
    """Each probe fails with this probability, whatever its point; a jump of f is met by next to none of them."""
    u = rng.normal(3.5, 0.3, (50, 3))
    noisy = FunctionProblem(lambda x: np.where(rng.random(len(x)) < share, -1.0, 1.0), 3)
    assert drive(_is_noisy(Simulator(noisy), u, 0.0, rng), noisy).value == (share < 1)
    jump = FunctionProblem(lambda x: np.where(x[:, 0] > 2.0, -1.0, 1.0), 3)
    steps = _is_noisy(Simulator(jump), u, 0.0, rng)
    found = drive(steps, jump)
    assert not found.value
    assert len(found.f) == SETTINGS.probes


def paths_around(centre, rng, n=20, steps=5):
    proposals = rng.standard_normal((n, steps, len(centre))) + centre
    return proposals, ChainPaths(proposals, proposals, np.zeros((n, steps)), np.ones(n))


def test_direction_is_where_f_falls_or_that_of_the_mean(rng):
    """A linear f shows its gradient, also where the points are elsewhere; an indicator only where they are."""
    centre, axis = np.array([0.0, 0.0, 4.0]), np.array([0.6, 0.8, 0.0])
    proposals, paths = paths_around(centre, rng)
    linear = _estimate_direction(paths._replace(f=3.0 - proposals @ axis), None)
    np.testing.assert_allclose(linear, axis, atol=0.02)
    flat = _estimate_direction(paths, None)
    mean = paths.states[:, -SETTINGS.mean_steps :].mean(axis=(0, 1))
    np.testing.assert_allclose(flat, mean / np.linalg.norm(mean))


def test_points_of_subset_simulation_join_a_region_with_few_points(rng):
    """Those with the lowest f; infinite outcomes are above all others."""
    few, enough = (Region(np.zeros((1, 1, 4)), rng.standard_normal((n, 4)), np.arange(float(n))) for n in (11, 12))
    f = np.append(np.arange(8.0), [np.inf, np.inf])
    descent = SubsetPoints(np.zeros((0, 4)), rng.standard_normal((10, 4)), f)
    joined = _add_subset_points(few, descent)
    np.testing.assert_array_equal(joined.f, np.concatenate([few.f, np.arange(7.0)]))
    np.testing.assert_array_equal(joined.u[11:], descent.u[:7])
    assert _add_subset_points(enough, descent) is enough
    assert _add_subset_points(few, descent._replace(u=descent.u[:0], f=f[:0])) is few


def test_chains_grow_in_two_regions(drive, rng):
    """Beyond u1 = 3 and beyond u2 = 3: two regions, each with chains of the normal distribution beyond its plane."""
    problem = half_spaces(5, 3.0, 3.0)
    starts = rng.standard_normal((60, 5))
    starts[np.arange(60), np.arange(60) % 2] = 4.5
    nothing = SubsetPoints(np.empty((0, 5)), np.empty((0, 5)), np.empty(0), levels=3)
    found = drive(grow_regions(Simulator(problem), starts, nothing, 0.0, 10**6, rng), problem).value
    assert len(found.regions) == 2
    assert (found.noisy, found.scattered, found.levels) == (False, False, 3)
    for region in found.regions:
        assert (problem.evaluate(region.points) <= 0).all()
        np.testing.assert_array_equal(problem.evaluate(region.u), region.f)
        own = int(region.points[:, :2].mean(axis=0).argmax())
        n_chains = len(region.chains)
        tail = stats.truncnorm(3.0, np.inf)
        error = tail.std() / math.sqrt(n_chains)  # a chain is worth one point at least
        assert region.points[:, own].mean() == pytest.approx(tail.mean(), abs=4 * error)


def test_the_limit_of_simulations_ends_the_comparison(drive, rng):
    """The points that are left over go to the region with the nearest mean, without a simulation."""
    problem = half_spaces(2, 3.0, 3.0)
    u = np.concatenate([rng.normal(0, 0.1, (20, 2)) + 3.4 * np.eye(2)[k] for k in range(2)])
    simulator = Simulator(problem)
    labels, _ = drive(label_regions(simulator, u, 0.0, 60), problem).value
    assert simulator.n_sim == 39 + 19  # all others with the first point, those left over with the second
    assert set(labels[:20]) != set(labels[20:])
    labels, _ = drive(label_regions(simulator := Simulator(problem), u, 0.0, 40), problem).value
    assert simulator.n_sim == 39
    assert set(labels[:20]) != set(labels[20:])


def test_few_points_are_compared_all_at_once(drive):
    """Three regions: of twelve points those of the first are found one after the other, the rest in one batch."""
    problem = half_spaces(3, 3.0, 3.0, 3.0)
    u = np.repeat(3.1 * np.eye(3), [6, 4, 2], axis=0) * np.linspace(1.0, 1.1, 12)[:, None]
    sizes = []
    steps = label_regions(Simulator(problem), u, 0.0, 10**6)
    counted = FunctionProblem(lambda x: sizes.append(len(x)) or problem.evaluate(x), 3)
    labels, _ = drive(steps, counted).value
    assert sizes == [11, 6 * 5 // 2]
    np.testing.assert_array_equal(labels, np.repeat([0, 1, 2], [6, 4, 2]))
