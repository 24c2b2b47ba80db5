"""Fresh draws from a fixed proposal: p, its spread, its interval and its doubts, against the formulas written out."""

import math

import numpy as np
import pytest
from scipy import stats

from samplers.importance import count_final_draws, defensive_mixture, simulate_until
from samplers.limit_states import half_space
from samplers.method import Goal
from samplers.problem import FunctionProblem
from samplers.proposals import Gaussian


def test_final_draws_are_what_is_left_or_what_was_set():
    assert count_final_draws(Goal(gamma=0.0, max_sim=5000), spent=1200, n_final=1000) == 3800
    assert count_final_draws(Goal(gamma=0.0), spent=1200, n_final=1000) == 1000
    assert count_final_draws(Goal(gamma=0.0, target_cov=0.1), spent=1200, n_final=1000) == 100_000


def test_no_weight_exceeds_one_over_the_base_s_share(rng):
    base, far, wide = (Gaussian(np.full(2, m), s * np.eye(2)) for m, s in ((0.0, 1.0), (3.0, 0.1), (3.0, 4.0)))
    u = 4.0 * rng.standard_normal((2000, 2))
    for wide_share in (0.0, 0.25):
        mixture = defensive_mixture(base, wide, far, 0.125, wide_share)
        parts = [0.125 * np.exp(base.log_prob(u)), wide_share * np.exp(wide.log_prob(u))]
        density = sum(parts) + (0.875 - wide_share) * np.exp(far.log_prob(u))
        np.testing.assert_allclose(mixture.log_prob(u), np.log(density))
        assert (base.log_prob(u) - mixture.log_prob(u)).max() <= math.log(8.0) * (1 + 1e-12)


def until(drive, limit, batch, **goal):
    problem, told = half_space(2, 1.0).problem, []
    steps = simulate_until(
        problem,
        Gaussian(np.full(2, 0.7), np.eye(2)),
        Goal(gamma=0.0, on_level=told.append, **goal),
        limit,
        batch,
        np.random.default_rng(0),
    )
    draws, trace, stopped = drive(steps, problem).value
    assert told == trace
    return draws, trace, stopped


def test_batches_up_to_a_limit_or_a_target(drive):
    draws, trace, stopped = until(drive, 2500, 1000)
    assert [level.n_sim for level in trace] == [level.n_points for level in trace] == [1000, 1000, 500]
    assert (draws.n, stopped) == (2500, False)
    assert (trace[-1].estimate, trace[-1].cov, trace[-1].ess) == (draws.p, draws.cov, draws.ess)
    assert trace[0].p == pytest.approx(stats.norm.sf(1.0 - 0.7 * math.sqrt(2)), abs=4 * 0.5 / math.sqrt(1000))
    assert draws.p == pytest.approx(stats.norm.sf(1.0), rel=4 * draws.cov)
    draws, trace, _ = until(drive, 100_000, 500, target_cov=0.02)
    assert trace[-1].cov <= 0.02 < trace[-2].cov


def test_stopped_on_the_way_there_is_what_was_drawn(drive):
    problem = FunctionProblem(lambda u: 1.0 - u[:, 0], 2)
    steps = simulate_until(problem, Gaussian.standard(2), Goal(gamma=0.0), 3000, 1000, np.random.default_rng(0))
    draws, trace, stopped = drive(steps, problem, interrupt_at=2).value
    assert (draws.n, len(trace), stopped) == (2000, 2, True)
