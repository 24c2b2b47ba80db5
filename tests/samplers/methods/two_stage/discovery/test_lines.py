from dataclasses import replace

import numpy as np
import pytest

from samplers.methods.two_stage.discovery.lines import _choose_tries, choose_roots, walk_lines
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS
from samplers.methods.two_stage.simulator import Simulator
from samplers.problem import FunctionProblem
from tests.samplers.methods.two_stage.driven import driven

LINES = DEFAULT_SETTINGS.lines


def walk(problem, n, rng, gamma=0.0):
    """Walk from the best of 500 base draws; return where lines start and end, which fail, and the simulations."""
    simulator, u = Simulator(problem), rng.standard_normal((500, problem.dim))
    f = problem.evaluate(u)
    roots = choose_roots(f, n, rng)
    ends, failing = driven(walk_lines(simulator, u[roots], f[roots], gamma, 1.0, rng), problem)
    return u[roots], ends, failing, simulator.n_sim


@pytest.mark.parametrize("dim", [2, 30, 100])
def test_lines_come_to_a_half_space_within_their_budget(dim, rng):
    problem = FunctionProblem(lambda u: 3.5 - u[:, 0], dim)
    _, ends, failing, n_sim = walk(problem, 20, rng)
    assert failing.mean() >= 0.4  # stragglers are left behind once 0.6 have arrived, or at the limit
    assert (ends[failing, 0] >= 3.5).all()
    assert n_sim < LINES.limit + 20


def test_no_line_ends_because_another_is_lower(rng):
    """Two regions of a share of a half; where f is ten times as steep, subset simulation hardly ever comes."""
    problem = FunctionProblem(lambda u: np.minimum(10 * (3.5 - u[:, 0]), 3.5 - u[:, 1]), 5)
    ends = [walk(problem, LINES.n, np.random.default_rng(seed))[1:3] for seed in range(8)]
    steep = sum(int((u[failing, 0] >= 3.5).sum()) for u, failing in ends)
    flat = sum(int((u[failing, 1] >= 3.5).sum()) for u, failing in ends)
    assert steep >= 12  # 23 on average
    assert flat >= 12


def test_each_line_moves_downhill_only(rng):
    problem = FunctionProblem(lambda u: np.abs(u - 2.0).sum(axis=1), 4)
    start, ends, failing, n_sim = walk(problem, 10, rng, gamma=-1.0)  # never reached
    assert not failing.any()
    assert (problem.evaluate(ends) < problem.evaluate(start)).all()
    assert LINES.first_look <= n_sim < LINES.first_look + 10


def test_roots_are_a_random_part_of_the_lowest(rng):
    f = rng.permutation(np.arange(500.0))
    roots = choose_roots(f, 20, rng)
    assert len(set(roots)) == 20
    assert (f[roots] < 50).all()
    assert set(roots) != set(choose_roots(f, 20, rng))
    assert len(set(choose_roots(np.zeros(500), 20, rng))) == 20
    assert len(choose_roots(f[:8], 20, rng)) == 8


def test_lines_that_fail_at_once_need_no_simulation(rng):
    problem = FunctionProblem(lambda u: u[:, 0], 2)
    start, ends, failing, n_sim = walk(problem, 20, rng, gamma=10.0)
    assert failing.all()
    assert n_sim == 0
    np.testing.assert_array_equal(start, ends)


def test_of_several_tries_the_first_gain_counts_else_the_first_tie():
    new = np.array([[5.0, 3.0, 1.0], [5.0, 4.0, 4.0], [6.0, 7.0, 8.0], [4.0, 5.0, 3.0]])
    assert _choose_tries(np.full(4, 4.0), new)[[0, 1, 3]].tolist() == [1, 1, 2]  # no matter which in the third line


def test_the_longer_it_takes_the_fewer_lines_go_on(rng):
    """Towards a half-space 40 standard deviations away: 24 lines at first, one once 300 steps are taken."""
    problem, sizes = FunctionProblem(lambda u: 40.0 - u[:, 0], 3), []

    def f(u):
        sizes.append(len(u))
        return problem.evaluate(u)

    patient, u = replace(LINES, limit=20_000, first_look=20_000), rng.standard_normal((24, 3))
    steps = walk_lines(Simulator(problem), u, problem.evaluate(u), 0.0, 1.0, rng, patient)
    driven(steps, FunctionProblem(f, 3))
    assert sizes[:13] == [24] * 13
    assert sizes[20] == 15  # 300 / 20 lines
    assert sizes[25] == 12 * 2  # lines, tries
    assert len(sizes) > 310
    assert set(sizes[310:]) == {1 * 3}
