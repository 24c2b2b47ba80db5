"""Regression by pieces: exact pieces, points that belong to none, and pieces without points."""

import numpy as np
import pytest

from samplers.methods.two_stage.mixture import piecewise_linear
from samplers.methods.two_stage.mixture.piecewise_linear import (
    LinearPieces,
    assign_points,
    fit_pieces,
    points_of_piece,
    start_pieces,
)
from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS

SETTINGS = DEFAULT_MIXTURE_SETTINGS.pieces
TRUE = LinearPieces(np.array([1.0, 0.5]), np.array([[1.0, 0.0, 0.0], [0.0, -2.0, 0.0]]))


def points(rng, n=400):
    u = rng.standard_normal((n, 3))
    return u, TRUE.predict(u).min(axis=1)


def perturbed(rng):
    return LinearPieces(TRUE.intercepts + 0.3, TRUE.slopes + 0.3 * rng.standard_normal(TRUE.slopes.shape))


def test_pieces_near_the_true_ones_become_them(rng):
    """The ridge of 1e-3 on some 200 points takes about 1e-5 off a slope."""
    u, y = points(rng)
    found = fit_pieces(perturbed(rng), u, y, SETTINGS)
    np.testing.assert_allclose(found.intercepts, TRUE.intercepts, atol=1e-4)
    np.testing.assert_allclose(found.slopes, TRUE.slopes, atol=1e-4)


def test_points_of_something_else_are_left_out(rng):
    """A tenth of the values are far higher, as those of another failure region are."""
    u, y = points(rng)
    y = np.where(rng.random(len(y)) < 0.1, y + 4.0, y)
    sigmas = DEFAULT_MIXTURE_SETTINGS.linear_model.inlier_sigmas
    found = fit_pieces(fit_pieces(TRUE, u, y, SETTINGS), u, y, SETTINGS, sigmas)
    np.testing.assert_allclose(found.slopes, TRUE.slopes, atol=1e-3)
    _, agrees, _ = assign_points(found, u, y, sigmas)
    assert 0.85 < agrees.mean() < 0.95


def test_an_exact_piece_does_not_rule_out_the_points_of_a_rough_one(rng):
    """Deviations are judged piece by piece: most points are of the exact one."""
    u, y = points(rng)
    own = TRUE.predict(u).argmin(axis=1)
    y = y + np.where(own == 1, rng.normal(0, 0.1, len(y)), 0.0)
    piece, agrees, _ = assign_points(TRUE, u, y, 3.0)
    np.testing.assert_array_equal(piece, own)
    assert agrees[own == 0].all()
    assert agrees[own == 1].mean() > 0.95


def test_a_fit_that_gains_nothing_ends(rng, monkeypatch):
    """Of noise pieces explain nothing, and points go to and fro until the steps are used up."""
    u = rng.standard_normal((400, 3))
    start = start_pieces(u, rng.standard_normal(400), np.arange(6), SETTINGS)
    y = rng.standard_normal(400)
    steps = []
    assign = piecewise_linear.assign_points
    monkeypatch.setattr(
        piecewise_linear, "assign_points", lambda *arguments: steps.append(arguments) or assign(*arguments)
    )
    fit_pieces(start, u, y, SETTINGS)
    all_steps = len(steps)
    fit_pieces(start, u, y, SETTINGS, patience=2)
    assert len(steps) - all_steps < all_steps
    np.testing.assert_allclose(
        fit_pieces(perturbed(rng), *points(rng), SETTINGS, patience=2).slopes, TRUE.slopes, atol=1e-4
    )


def test_a_piece_with_too_few_points_is_given_up(rng):
    u, y = points(rng)
    third = LinearPieces(np.append(TRUE.intercepts, 50.0), np.vstack([TRUE.slopes, np.zeros(3)]))
    assert len(fit_pieces(third, u, y, SETTINGS).intercepts) == 2
    assert fit_pieces(TRUE, u[:5], y[:5], SETTINGS) is None


@pytest.mark.parametrize("n", [1, 7])
def test_pieces_start_as_regressions_around_points(rng, n):
    """Where all points are of one piece, every start is near it: the first ridge is 0.3."""
    u = rng.standard_normal((100, 3))
    start = start_pieces(u, 2.0 - u[:, 1], np.arange(n), SETTINGS)
    assert start.slopes.shape == (n, 3)
    np.testing.assert_allclose(start.slopes, np.tile([0.0, -1.0, 0.0], (n, 1)), atol=0.4)
    assert points_of_piece(3, SETTINGS) == 12
