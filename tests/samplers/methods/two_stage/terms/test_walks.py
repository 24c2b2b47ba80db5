import numpy as np
import pytest
from scipy.stats import norm

import samplers
from samplers.methods.two_stage.terms.settings import WalkSettings
from samplers.methods.two_stage.terms.walks import (
    Directions,
    choose_starts,
    choose_terms,
    count_walks,
    describe_half_spaces,
    walk_downhill,
)
from samplers.problem import Terms

SETTINGS = WalkSettings()


def table(values, ticks=None):
    values = np.asarray(values, dtype=float)
    return Terms(values.min(axis=1), values, np.zeros(values.shape, dtype=int) if ticks is None else ticks, 0.0)


def test_terms_that_are_the_least_among_low_draws_are_main_ones(rng):
    """Of 600 draws the first term is the least of most, the second of a few low ones, the third of high ones only."""
    values = np.column_stack([2 + rng.random(600), np.full(600, 9.0), np.full(600, 2.9), np.full(600, 50.0)])
    values[:10, 1] = 0.5
    main, others = choose_terms(table(values), SETTINGS)
    assert (main, others) == ([0, 1], [2, 3])  # the one that ever is the least before the one that never is


def test_no_term_that_ever_is_the_least_is_left_out_however_many():
    values = np.full((40, 40), 99.0)
    np.fill_diagonal(values, np.arange(1.0, 41.0))
    main, others = choose_terms(table(values), WalkSettings(candidate_share=0.1, max_scouted=3))
    assert sorted(main + others) == list(range(40))


def test_rows_without_an_outcome_are_not_counted():
    assert choose_terms(table(np.full((3, 2), -np.inf)), SETTINGS) == ([], [])


def test_walks_start_low_and_half_of_them_late():
    values = np.arange(100.0)[:, None]
    ticks = (np.arange(100) % 10 == 0).astype(int)[:, None] * 50  # one in ten is late
    rows = choose_starts(table(values, ticks), 0, 8, SETTINGS)
    assert sorted(rows) == [0, 1, 2, 3, 4, 10, 20, 30]
    assert list(choose_starts(table(values), 0, 3, SETTINGS)) == [0, 1, 2]


def test_walks_end_just_beyond_the_plane_of_their_own_term(half_spaces, simulator_of, answer, rng):
    """From distance 4 with steps of 1.3, 1.69, 2.2 at most three steps; ends are 0.03 beyond; no gradient is wasted."""
    problem, _, normals = half_spaces(50, 1e-4, shares=(0.5, 0.5))
    u = 0.1 * rng.standard_normal((6, 50))
    term = np.array([0, 0, 0, 1, 1, 1])
    simulator = simulator_of(problem)
    walks = answer(walk_downhill(simulator, u, problem.terms(u), term, 0.0, 10**6, SETTINGS), problem)
    np.testing.assert_allclose(walks.values, -0.03, atol=1e-9)
    moved = walks.u - u
    np.testing.assert_allclose(moved, (moved @ normals.T) @ normals, atol=1e-9)
    np.testing.assert_allclose(np.abs(walks.directions.of(1).values @ normals.T), [[0.0, 1.0]] * 9, atol=1e-9)
    np.testing.assert_array_equal(walks.failing_terms, term)
    assert simulator.n_sim == 6 * 3 + 6 * 3 * problem.gradient_cost
    np.testing.assert_allclose(walks.distance, -norm.ppf(0.5e-4))


def test_a_step_uphill_is_taken_back_and_shortened(simulator_of, answer):
    """f falls along x0 for half a unit and rises again; the first step of 1.3 overshoots, the next ones do not."""
    problem = samplers.FunctionProblem(
        dim=2,
        terms=lambda x: 0.2 + (x[:, :1] - 0.5) ** 2,
        gradient=lambda x, term: np.column_stack([2 * (x[:, 0] - 0.5), np.zeros(len(x))]),
    )
    u = np.array([[-0.1, 0.0]])
    walks = answer(
        walk_downhill(simulator_of(problem), u, problem.terms(u), np.zeros(1, int), 0.0, 10**6, SETTINGS), problem
    )
    assert walks.values[0] < 0.21  # at -0.1 it was 0.56
    assert len(walks.failures) == 0


def test_walks_keep_to_their_limit(half_spaces, simulator_of, answer):
    problem, _, _ = half_spaces(50, 1e-6)
    u, simulator = np.zeros((10, 50)), simulator_of(problem)
    walks = answer(walk_downhill(simulator, u, problem.terms(u), np.zeros(10, int), 0.0, 55, SETTINGS), problem)
    assert simulator.n_sim == 40  # one step: ten gradients of 3 and ten points; a second one would need 40 more
    assert (walks.values > 0).all()


def test_walks_without_a_gradient_stay(half_spaces, simulator_of, answer):
    problem, _, _ = half_spaces(50, 1e-4, gradient=lambda x, term: np.full(x.shape, np.nan))
    u = np.zeros((2, 50))
    walks = answer(
        walk_downhill(simulator_of(problem), u, problem.terms(u), np.zeros(2, int), 0.0, 10**6, SETTINGS), problem
    )
    np.testing.assert_array_equal(walks.u, u)
    assert len(walks.directions.values) == 0


@pytest.mark.parametrize(
    ("budget", "step", "expected"),
    [(6000, 7.5, (18, 8)), (2000, 7.5, (6, 4)), (1000, 7.5, (4, 0)), (1000, 4.0, (6, 3))],
)
def test_walks_are_as_many_as_can_make_two_steps(budget, step, expected):
    """With 4 main terms and 8 others; a quarter of the budget is for walks: at 1,000 and 7.5 a step 250 / 15 = 16."""
    assert count_walks(4, 8, budget, step, WalkSettings()) == expected


def test_directions_are_found_by_term():
    directions = Directions(np.array([0, 1, 0]), np.eye(3), 2 * np.eye(3))
    mine = directions.of(0)
    np.testing.assert_array_equal(mine.values, np.eye(3)[[0, 2]])
    np.testing.assert_array_equal(mine.design_points, 2 * np.eye(3)[[0, 2]])
    np.testing.assert_array_equal(directions.join(mine).term, [0, 1, 0, 0, 0])


def test_design_points_are_those_of_the_half_spaces_near_which_gradients_were_taken(rng):
    """f = 3 (4 - n.u): the nearest point is 4 n wherever f was differentiated; from 3 away it is not believed."""
    n = np.array([0.6, 0.8, 0.0])
    across = rng.standard_normal((5, 3))
    u = across - np.outer(across @ n, n) + np.outer([4.5, 3.0, 1.0, 4.0, 4.0], n)
    slopes = np.tile(-3.0 * n, (5, 1))
    slopes[3], slopes[4] = np.nan, 0.0
    found = describe_half_spaces(np.arange(5), u, slopes, 3.0 * (4.0 - u @ n))
    np.testing.assert_array_equal(found.term, [0, 1, 2])
    np.testing.assert_allclose(found.values, np.tile(-n, (3, 1)))
    np.testing.assert_allclose(found.design_points, [4 * n, 4 * n, np.full(3, np.nan)])


def test_walks_do_not_go_where_nothing_ever_happens(half_spaces, simulator_of, answer):
    """Phi(-7.3) = 1e-13: one gradient shows it."""
    problem, _, _ = half_spaces(50, 1e-13, shares=(1.0,))
    u, simulator = np.zeros((2, 50)), simulator_of(problem)
    answer(walk_downhill(simulator, u, problem.terms(u), np.zeros(2, int), 0.0, 10**6, SETTINGS), problem)
    assert simulator.n_sim == 6
