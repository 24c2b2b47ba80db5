import numpy as np
import pytest
from scipy import stats

from samplers.methods.two_stage.discovery.wide import (
    WideFailures,
    bisect_towards_origin,
    draw_wide,
    find_wide_failures,
)
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS
from samplers.methods.two_stage.simulator import Simulator
from samplers.problem import FunctionProblem

EXPLORE = DEFAULT_SETTINGS.exploration
HALF_SPACE = FunctionProblem(lambda u: 3.0 - u[:, 0], 3)


def test_points_are_drawn_in_along_their_rays_and_still_fail(drive, rng):
    u = rng.normal(0.0, 3.0, (200, 3))
    u[:, 0] = rng.uniform(3.0, 12.0, 200)
    near = drive(bisect_towards_origin(Simulator(HALF_SPACE), u, 0.0, EXPLORE.bisections), HALF_SPACE).value
    assert (near[:, 0] >= 3.0).all()
    ratio = near[:, 0] / u[:, 0]
    np.testing.assert_allclose(near, ratio[:, None] * u)
    assert (ratio <= 1).all()
    assert (ratio - 3.0 / u[:, 0] <= 0.5**EXPLORE.bisections + 1e-12).all()


def test_starts_are_half_the_least_wide_and_half_at_random(rng):
    scale = rng.permutation(np.repeat([1.5, 2.2, 3.0], [15, 40, 100]))
    wide = WideFailures(np.arange(155.0)[:, None], scale, np.zeros(155))
    chosen = wide.choose(30, rng)[:, 0].astype(int)
    assert len(set(chosen)) == 30
    assert np.count_nonzero(scale[chosen] == 1.5) == 15
    assert np.count_nonzero(scale[chosen] == 3.0) >= 3
    few = WideFailures(wide.u[:10], scale[:10], np.zeros(10))
    assert set(few.choose(30, rng)[:, 0]) == set(range(10))


@pytest.mark.parametrize("seed", range(20))
def test_a_region_with_few_wide_failures_is_not_left_out(seed):
    """Of 100 failures 4 are in a region of their own: at random 36 % of the choices would have none of them."""
    rng = np.random.default_rng(seed)
    axes = np.repeat([[4.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, -4.0, 0.0, 0.0, 0.0, 0.0]], [96, 4], axis=0)
    u = axes + rng.standard_normal((100, 6))
    chosen = WideFailures(u, np.full(100, 2.2), np.zeros(100)).choose(24, rng)
    assert len(np.unique(chosen, axis=0)) == 24
    assert np.count_nonzero(chosen[:, 1] < -2.0) >= 1


def test_wide_failures_have_the_weights_of_their_mixture(drive, rng):
    draws = drive(draw_wide(Simulator(HALF_SPACE), ((1.5, 4000), (3.0, 4000)), rng), HALF_SPACE).value
    wide = WideFailures.among(draws, 0.0)
    assert (wide.u[:, 0] >= 3.0).all()
    terms = np.exp(wide.log_weights)  # over all draws: their sum estimates P[u_1 >= 3]
    se = np.sqrt((terms**2).sum())
    assert abs(terms.sum() - stats.norm.sf(3.0)) < 4 * se
    assert set(wide.scale) == {1.5, 3.0}


def finish(steps):
    """Return what a generator returns that needs no simulation."""
    with pytest.raises(StopIteration) as end:
        next(steps)
    return end.value.value


@pytest.mark.parametrize(("levels", "more"), [(5, 0), (6, 80), (9, 80)])
def test_wide_draws_are_as_deep_as_the_levels_went(drive, rng, levels, more):
    """10^-6.5 is beyond 4.98, 10^-9.5 beyond 6.2 standard deviations; these over 1.45 are 3.4 and 4.3."""
    simulator = Simulator(HALF_SPACE)
    first = drive(draw_wide(simulator, ((1.5, 200),), rng), HALF_SPACE).value
    spent = simulator.n_sim
    steps = find_wide_failures(simulator, first, 0.0, levels, 80, rng, EXPLORE)
    wide = drive(steps, HALF_SPACE).value if more else finish(steps)
    assert simulator.n_sim - spent == more
    deep = max(wide.scale)
    assert deep == pytest.approx({5: 1.5, 6: 3.44, 9: 4.26}[levels], abs=0.01)
