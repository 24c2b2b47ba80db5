"""Conditionals one by one: shapes, chunks, and the agreement of density, map and draws with those of plain boxes."""

import numpy as np
import pytest

from rare_envs.distributions.coordinates import CoordinateKind, Coordinates
from rare_envs.distributions.mixture import CHUNK_ROWS, CoordinateMixture, TruncatedGaussianMixture

KINDS: tuple[CoordinateKind, ...] = ("plain", "plain")
BOX = Coordinates([-1.0, -1.0], [2.0, 2.0], KINDS, names=("a", "b"), order=("b", "a"))
MEANS = [[0.0, 1.0], [1.0, -1.0]]
COVARIANCES = [[[1.0, 0.5], [0.5, 2.0]], [[0.3, 0.0], [0.0, 0.3]]]
PARTS = ([0.5, 0.5], MEANS, COVARIANCES)


def test_an_order_of_columns_is_the_mixture_with_columns_exchanged() -> None:
    """The mixture's arrays are in the order (b, a); columns of x and u stay where they are."""
    exchanged = CoordinateMixture(BOX, *PARTS)
    plain = TruncatedGaussianMixture(*PARTS, [-1.0, -1.0], [2.0, 2.0])
    u = np.random.default_rng(0).standard_normal((1000, 2))
    x = exchanged.from_standard_normal(u)
    assert (x[:, ::-1] == plain.from_standard_normal(u[:, ::-1])).all()
    assert (exchanged.log_prob(x) == plain.log_prob(x[:, ::-1])).all()
    assert (exchanged.to_standard_normal(x)[:, ::-1] == plain.to_standard_normal(x[:, ::-1])).all()
    same = [each.sample(1000, np.random.default_rng(1)) for each in (exchanged, plain)]
    assert (same[0][:, ::-1] == same[1]).all()


def test_chunks_do_not_show() -> None:
    conditionals = CoordinateMixture(BOX, *PARTS)
    x = conditionals.sample(CHUNK_ROWS + 7, np.random.default_rng(1))
    whole = conditionals.log_prob(x)
    assert (whole[CHUNK_ROWS - 3 :] == conditionals.log_prob(x[CHUNK_ROWS - 3 :])).all()


def test_shapes_and_points_are_checked() -> None:
    with pytest.raises(ValueError, match=r"means of shape \(2, 2\), one for each column, got \(2, 1\)"):
        CoordinateMixture(BOX, [0.5, 0.5], [[0.0], [1.0]], [[[1.0]], [[1.0]]])
    conditionals = CoordinateMixture(BOX, *PARTS)
    with pytest.raises(ValueError, match=r"Expected x of shape \(n, 2\), got \(3, 1\)"):
        conditionals.rows("x", np.zeros((3, 1)))
    with pytest.raises(ValueError, match=r"x\[1, 0\] = 5 is outside the box"):
        conditionals.rows_in_box([[0.0, 0.0], [5.0, 0.0]])
