import numpy as np
import pytest

from samplers.methods.two_stage.terms.history import TermHistory
from samplers.methods.two_stage.terms.rounds import mix_terms, pursue_walked, refit_terms
from samplers.methods.two_stage.terms.settings import DEFAULT_TERM_SETTINGS, RoundSettings
from samplers.methods.two_stage.terms.walks import Directions, Walks

SETTINGS = DEFAULT_TERM_SETTINGS


def walked(normals, distances):
    """Return walks that ended in failures at these distances along the normals, three for each term."""
    term = np.repeat(np.arange(len(normals)), 3)
    u = np.array(distances)[term, None] * normals[term]
    directions = Directions(term, -normals[term], u)
    none = np.empty(0, dtype=np.int64)
    beta = np.array(distances)[term]
    return Walks(term, u, np.full(len(u), -0.03), np.ones(len(u)), np.zeros(len(u), int), beta, directions, u[:0], none)


def base_history(problem, rng, n=600):
    u = rng.standard_normal((n, problem.dim))
    return TermHistory.of_base_draws(u, problem.terms(u))


def test_a_term_that_hardly_fails_is_left_to_base_draws(half_spaces, rng):
    """Phi(-6) is a 1e-9 of Phi(-3); Phi(-4) is 2 % of it and stays."""
    problem, _, normals = half_spaces(50, 1e-3)
    pursued = pursue_walked(walked(normals, [3.0, 4.0, 6.0]), base_history(problem, rng), SETTINGS)
    assert [one.number for one in pursued] == [0, 1]


def test_a_walk_that_came_half_way_is_enough_and_one_that_did_not_is_not(half_spaces, rng):
    problem, _, normals = half_spaces(50, 1e-4, shares=(0.5, 0.5))
    history, walks = base_history(problem, rng), walked(normals, [3.0, 3.0])
    walks.values[:] = [0.5, 1.0, 1.5, 3.0, 3.5, 4.0]  # they began at 1
    (only,) = pursue_walked(walks, history, SETTINGS)
    assert only.number == 0
    np.testing.assert_array_equal(only.ends, walks.u[:2])  # the lower half


def test_shares_of_ready_terms_follow_their_weights(half_spaces, rng, answer, simulator_of):
    """Terms with 80, 15 and 5 % of p = 0.3: of base draws sqrt(sum W^2) goes with sqrt(p_j), 0.59 : 0.26 : 0.15.

    The least share, 0.17, is that of the last.
    """
    problem, _, normals = half_spaces(20, 0.3)
    history, start = base_history(problem, rng, 20_000), walked(normals, [1.0, 1.0, 1.0])
    pursued = pursue_walked(start, history, SETTINGS)
    first = mix_terms(pursued, history, 0.0, RoundSettings())
    np.testing.assert_allclose(first.shares, 1 / 3)  # none is ready: all alike
    final = mix_terms(pursued, history, 0.0, RoundSettings(), final=True).shares
    pursued = answer(refit_terms(simulator_of(problem), history, pursued, 0.0, 10**6, rng, SETTINGS), problem)
    assert all(one.ready for one in pursued)
    failing = history.terms.f <= 0
    parts = np.sqrt([(failing & (history.terms.least == j)).sum() for j in range(3)])
    shares = mix_terms(pursued, history, 0.0, RoundSettings()).shares
    wanted = np.maximum(parts / parts.sum(), RoundSettings().min_term_share)
    np.testing.assert_allclose(shares, wanted / wanted.sum(), rtol=1e-9)
    np.testing.assert_allclose(final, shares)  # nobody waits for a term that was not reached


def test_one_heavy_failure_does_not_give_its_term_the_next_round(half_spaces, rng):
    """Of two terms with 300 failures each, one failure of the first weighs as much as all others together."""
    problem, _, normals = half_spaces(20, 0.3, shares=(0.5, 0.5))
    history = base_history(problem, rng, 2000)
    mine = np.flatnonzero(history.failing(0.0) & (history.terms.least == 0))[0]
    log_density = history.log_density.copy()
    log_density[mine] -= np.log(history.failing(0.0).sum())
    heavy = TermHistory(history.u, history.terms, log_density, (), history.n_base)
    pursued = pursue_walked(walked(normals, [1.0, 1.0]), heavy, SETTINGS)
    shares = mix_terms(pursued, heavy, 0.0, RoundSettings(), final=True).shares
    assert shares[0] < 0.75
    plain = mix_terms(pursued, heavy, 0.0, RoundSettings(share_ess=1.0), final=True).shares
    assert plain[0] > 0.8


def test_a_fit_makes_gradients_within_its_limit_and_takes_up_new_terms(half_spaces, rng, answer, simulator_of):
    """The second term fails among the draws and nobody pursued it: it joins with gradients of its own."""
    problem, _, normals = half_spaces(20, 0.2, shares=(0.5, 0.5))
    history = base_history(problem, rng)
    pursued = [one for one in pursue_walked(walked(normals, [1.0, 1.0]), history, SETTINGS) if one.number == 0]
    simulator = simulator_of(problem)
    result = answer(refit_terms(simulator, history, pursued, 0.0, 10**6, rng, SETTINGS), problem)
    assert [one.number for one in result] == [0, 1]
    assert simulator.n_sim == 2 * SETTINGS.rounds.gradients * problem.gradient_cost
    assert np.abs(result[1].law.axes.T @ normals[1]) == pytest.approx(1.0)
    tight = simulator_of(problem)
    answer(refit_terms(tight, history, pursued, 0.0, 20, rng, SETTINGS), problem)
    assert 0 < tight.n_sim <= 20


def test_later_gradients_weigh_more(half_spaces, rng, answer, simulator_of):
    problem, _, normals = half_spaces(20, 0.2, shares=(1.0,))
    history = base_history(problem, rng)
    pursued = pursue_walked(walked(normals, [1.0]), history, SETTINGS)
    (once,) = answer(refit_terms(simulator_of(problem), history, pursued, 0.0, 10**6, rng, SETTINGS), problem)
    np.testing.assert_allclose(once.direction_weights, [1.0] * 3 + [1.5] * 12)
