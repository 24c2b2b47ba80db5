import numpy as np
import pytest

from samplers.benchmark.analytic_states import (
    bowl,
    concave,
    corner,
    half_spaces,
    hidden_box,
    islands,
    never,
    opposite,
    random_rotation,
    ring_part,
    round_to_steps,
    strip,
)

NEAR = {
    "half-spaces": half_spaces(3, (1.0, 1.4, 2.0), (1.0, 3.0, 0.4)),
    "noise": half_spaces(2, (1.5,), noise=0.5),
    "noise, two regions": half_spaces(4, (1.6, 1.9), noise=0.6),
    "opposite": opposite(2, 1.2, 1.5, (0.5, 10.0)),
    "stepped": round_to_steps(half_spaces(3, (1.2, 1.6))),
    "bowl": bowl(5, 1.0, 0.2),
    "concave": concave(2.5),
    "islands": islands([(1.0, 1.0, 0.0), (-1.0, 0.0, -1.0)], [0.6, 0.8]),
    "corner": corner(4, (0.5, 0.4, 0.2)),
    "strip": strip(4, beta=1.0),
    "ring": ring_part(5, p_radius=0.3, beta=0.8),
    "box": hidden_box(beta=1.5),
}


@pytest.mark.parametrize("state", NEAR.values(), ids=NEAR)
@pytest.mark.parametrize("rotation", [None, 3])
def test_probability_against_monte_carlo(state, rotation):
    """The same formulas with the failures near enough to be counted."""
    n = 200_000
    u = np.random.default_rng(1).standard_normal((n, state.dim))
    share = np.mean(state.problem(rotation).evaluate(u) <= 0)
    assert share == pytest.approx(state.p, abs=4 * np.sqrt(state.p / n))


def test_never_is_zero():
    assert never().p == 0.0
    assert (never().f(10.0 * np.random.default_rng(1).standard_normal((100_000, 4))) > 0).all()


def test_rotations_are_orthogonal_and_differ():
    first, second = random_rotation(6, 1), random_rotation(6, 2)
    np.testing.assert_allclose(first @ first.T, np.eye(6), atol=1e-14)
    assert np.abs(first - second).max() > 0.1


def test_noise_is_fresh_at_every_call_and_the_same_for_the_same_seed():
    state = half_spaces(2, (1.0,), noise=0.3)
    u = np.zeros((2000, 2))
    problem = state.problem(noise_seed=4)
    first, second = problem.evaluate(u), problem.evaluate(u)
    assert np.std(first) == pytest.approx(0.3, rel=0.1)
    assert not np.any(first == second)
    np.testing.assert_array_equal(state.problem(noise_seed=4).evaluate(u), first)
    assert not np.any(state.problem(noise_seed=5).evaluate(u) == first)


def test_steps_tie_and_fail_where_the_smooth_function_fails():
    smooth = half_spaces(3, (1.2, 1.6))
    u = np.random.default_rng(3).standard_normal((5000, 3))
    f = round_to_steps(smooth).f(u)
    np.testing.assert_array_equal(f <= 0, smooth.f(u) <= 0)
    assert len(np.unique(f)) < 20
    assert f.max() == 3.0
