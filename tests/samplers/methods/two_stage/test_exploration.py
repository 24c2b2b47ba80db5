import math

import numpy as np
import pytest
from scipy import stats

from samplers.limit_states import four_branches, plateau, shell
from samplers.method import Goal
from samplers.methods.two_stage.exploration import Sizes, find_regions, first_draws
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS, RegionSettings
from samplers.methods.two_stage.simulator import Simulator
from samplers.problem import FunctionProblem
from tests.samplers.methods.two_stage.driven import driven


def half_spaces(dim, *betas):
    """Beyond u_k >= beta_k, one coordinate for each."""
    return FunctionProblem(lambda u: np.min([beta - u[:, k] for k, beta in enumerate(betas)], axis=0), dim)


def rough(u):
    """Looks like independent N(0, 1) noise, but is a function of u."""
    share = 43758.5453 * np.sin(u @ np.linspace(9.1, 13.7, u.shape[1]))
    return stats.norm.ppf(np.clip(share - np.floor(share), 1e-9, 1 - 1e-9))


NOISY = FunctionProblem(lambda u: 3.5 - u.sum(axis=1) / math.sqrt(6) + 0.5 * rough(u), 6)
INDICATOR = FunctionProblem(lambda u: np.where(u[:, 0] > 3.0, -1.0, 1.0), 5)


def explored(problem, seed=0, budget=6000):
    """Return the first draws, what was found and how many simulations that took."""
    rng, simulator, sizes = np.random.default_rng(seed), Simulator(problem), Sizes.within(budget)
    first = driven(first_draws(simulator, sizes, rng), problem)
    found = driven(find_regions(simulator, first, Goal(gamma=0.0), sizes, rng), problem)
    return first, found, simulator.n_sim


@pytest.mark.parametrize("dim", [2, 30, 300])
def test_wide_draws_hit_a_half_space_at_the_predicted_rate(dim, rng):
    """Phi(-beta / s), whatever the dimension."""
    problem, sizes = half_spaces(dim, 3.0), Sizes.within(600_000)
    first = driven(first_draws(Simulator(problem), sizes, rng), problem)
    scales = [1.0, *(scale for scale, _ in sizes.wide)]
    assert first.counts.sum() == len(first.f) == len(first.u)
    for part, scale in zip(np.split(first.f, np.cumsum(first.counts)[:-1]), scales, strict=True):
        hits = int((part <= 0).sum())
        assert stats.binomtest(hits, len(part), stats.norm.sf(3.0 / scale)).pvalue > 1e-4


@pytest.mark.parametrize("dim", [1, 2, 30, 100])
def test_a_half_space_is_one_region(dim):
    for seed in range(5):
        _, found, _ = explored(half_spaces(dim, 3.5), seed)
        assert len(found.regions) == 1
        assert not found.noisy


@pytest.mark.parametrize("betas", [(3.4, 3.4), (3.4, 3.8)])
@pytest.mark.parametrize("dim", [2, 30])
def test_two_half_spaces_are_told_apart(dim, betas):
    """Orthogonal ones; half way between two typical points both coordinates are about beta / 2."""
    numbers = []
    for seed in range(8):
        _, found, _ = explored(half_spaces(dim, *betas), seed)
        numbers.append(len(found.regions))
        if dim > 2 and numbers[-1] == 2:
            beyond = np.array([(region.points[:, :2] >= betas).mean(axis=0) for region in found.regions])
            assert sorted(beyond.argmax(axis=1)) == [0, 1]
            assert (beyond.max(axis=1) > 0.9).all()
    assert numbers.count(2) >= 7


def test_no_region_where_nothing_fails():
    _, found, n_sim = explored(FunctionProblem(lambda u: np.ones(len(u)), 3))
    assert found.regions == []
    sizes, lines = Sizes.within(6000), DEFAULT_SETTINGS.lines
    first = sizes.base + sum(n for _, n in sizes.wide)
    assert first + lines.first_look <= n_sim < first + lines.first_look + lines.n  # no line arrives


PROBLEMS = {
    "half-space": half_spaces(2, 3.5),
    "half-space d=100": half_spaces(100, 3.5),
    "half-space d=1": half_spaces(1, 3.0),
    "far": half_spaces(10, 5.0),
    "two": half_spaces(10, 3.0, 3.2),
    "four branches": four_branches().problem,
    "shell": shell().problem,
    "circle": shell(2).problem,
    "plateau": plateau().problem,
    "indicator": INDICATOR,
    "cube": FunctionProblem(lambda u: 3.3 - np.abs(u).max(axis=1), 10),
    "eight corners": FunctionProblem(lambda u: 1.2 - np.abs(u[:, :3]).min(axis=1), 5),
    "noisy": NOISY,
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_chains_stay_among_the_failures_and_regions_are_whole(name):
    problem = PROBLEMS[name]
    _, found, n_sim = explored(problem)
    assert n_sim <= 0.65 * 6000  # what is left is for the rounds and the estimate
    assert 1 <= len(found.regions) <= RegionSettings().max_regions
    for region in found.regions:
        assert region.chains.ndim == 3
        assert (problem.evaluate(region.points) <= 0).all()
        np.testing.assert_array_equal(problem.evaluate(region.u), region.f)


def spent(name, budgets):
    """Of each budget, the most of two runs."""
    return np.array(
        [max(explored(PROBLEMS[name], seed, budget)[2] / budget for seed in range(2)) for budget in budgets]
    )


@pytest.mark.parametrize("name", PROBLEMS)
def test_something_is_left_of_a_budget_of_thousands(name):
    assert (spent(name, [2500, 4000, 10_000]) < 0.85).all()


def test_a_small_budget_is_not_exceeded():
    for name in PROBLEMS:
        assert (spent(name, [400, 450, 700, 1000, 1300]) < 1).all()


@pytest.mark.parametrize("name", ["half-space", "half-space d=100", "four branches"])
def test_levels_and_lines_share_their_batches(name):
    """One after the other they took 77, 93 and 76 batches on average of these seeds, chains included."""
    batches = []
    for seed in range(3):
        sizes = []
        f = PROBLEMS[name].evaluate
        explored(FunctionProblem(lambda u, f=f, sizes=sizes: sizes.append(len(u)) or f(u), PROBLEMS[name].dim), seed)
        batches.append(len(sizes))
    assert np.mean(batches) <= 60


def test_an_indicator_is_enough():
    """f = -1 or 1: the chains know where failures are, and that it is one region."""
    for seed in range(5):
        _, found, _ = explored(INDICATOR, seed)
        assert len(found.regions) == 1
        along = found.regions[0].points[:, 0]
        assert along.mean() == pytest.approx(stats.truncnorm(3, np.inf).mean(), abs=0.12)


def test_noise_is_noticed_and_steps_are_not_noise():
    assert explored(NOISY)[1].noisy
    assert not explored(PROBLEMS["indicator"])[1].noisy
    assert not explored(PROBLEMS["plateau"])[1].noisy
    assert not explored(FunctionProblem(lambda u: np.floor(4 * (3.0 - u[:, 0])), 3))[1].noisy


@pytest.mark.parametrize("budget", [400, 2000, 6000, 24_000, 600_000])
def test_sizes_leave_most_of_the_budget(budget):
    sizes = Sizes.within(budget)
    assert sizes.base + sum(n for _, n in sizes.wide) <= 0.15 * budget
    assert sizes.most <= 0.5 * budget
    more = Sizes.within(2 * budget)
    assert sizes.base < more.base <= 2 * sizes.base + 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["half-space", "half-space d=100", "indicator", "plateau"])
def test_one_region_is_one_in_nearly_all_runs(name):
    numbers = [len(explored(PROBLEMS[name], seed)[1].regions) for seed in range(100)]
    assert numbers.count(1) >= 97


@pytest.mark.slow
@pytest.mark.parametrize("dim", [10, 30, 60])
def test_two_half_spaces_are_told_apart_in_nearly_all_runs(dim):
    numbers = [len(explored(half_spaces(dim, 3.4, 3.8), seed)[1].regions) for seed in range(100)]
    assert numbers.count(2) >= 90
