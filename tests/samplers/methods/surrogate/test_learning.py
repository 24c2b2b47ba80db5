"""Points to learn from: the first design and the batches after it."""

import numpy as np
import pytest

from samplers.methods.kriging import LearningSettings, Prediction, fit_kriging
from samplers.methods.surrogate import (
    choose_batch,
    design_size,
    draw_design,
    draw_mixture_pool,
    first_mixture,
    learning_size,
)

SETTINGS = LearningSettings()


@pytest.mark.parametrize(("budget", "dim", "size"), [(60, 2, 12), (300, 2, 48), (300, 6, 72), (5000, 20, 228)])
def test_sizes(budget, dim, size):
    """A quarter of the budget, at most 30 + 10 d, in four equal parts; learning has two thirds, at most 300."""
    assert design_size(budget, dim, SETTINGS) == size
    assert design_size(budget, dim, SETTINGS) < learning_size(budget, SETTINGS) <= min(2 * budget / 3, 300)


def test_the_design_is_a_latin_hypercube_at_each_scale():
    u = draw_design(80, 3, SETTINGS.scales, np.random.default_rng(0))
    for k, scale in enumerate(SETTINGS.scales):
        part = u[20 * k : 20 * (k + 1)]
        assert part.std() == pytest.approx(scale, rel=0.2)
        assert ((part > 0).sum(axis=0) == 10).all()  # half of the strata of each coordinate


def test_a_batch_lies_at_the_limit_state_and_its_points_apart():
    rng = np.random.default_rng(1)
    u = draw_design(48, 2, SETTINGS.scales, rng)
    kriging = fit_kriging(u, 2.5 - u[:, 0])
    pool = draw_mixture_pool(kriging, first_mixture(2, SETTINGS.scales), 3000, rng)
    batch = choose_batch(kriging, pool, 8, SETTINGS, rng)
    assert batch.shape == (8, 2)
    assert np.abs(batch[:, 0] - 2.5).mean() < 0.5 * np.abs(pool.u[:, 0] - 2.5).mean()
    apart = np.linalg.norm(batch[:, None] - batch, axis=2)[np.triu_indices(8, 1)]
    assert apart.min() > 0.02


def test_a_certain_surrogate_still_gives_a_whole_batch():
    rng = np.random.default_rng(2)
    u = draw_design(48, 1, SETTINGS.scales, rng)
    kriging = fit_kriging(u, 2.5 - u[:, 0])
    pool = draw_mixture_pool(kriging, first_mixture(1, SETTINGS.scales), 200, rng)
    assert len(np.unique(choose_batch(kriging, pool, 8, SETTINGS, rng))) == 8


def test_three_in_ten_points_lie_where_a_surrogate_that_is_not_believed_leaves_both_open():
    """Of a certain one the doubtful points lie at its limit state, within 0.1; these reach to standard deviations."""
    rng = np.random.default_rng(3)
    u = draw_design(48, 2, SETTINGS.scales, rng)
    kriging = fit_kriging(u, 2.5 - u[:, 0])
    pool = draw_mixture_pool(kriging, first_mixture(2, SETTINGS.scales), 3000, rng)
    unsure = pool._replace(prediction=Prediction(pool.u[:, 0] - 2.5, np.full(3000, 0.5)))
    batch = choose_batch(kriging, unsure, 20, SETTINGS, rng)
    distance = np.abs(batch[:, 0] - 2.5)
    assert len(np.unique(batch, axis=0)) == 20
    assert np.median(distance[14:]) > 2 * np.median(distance[:14])
