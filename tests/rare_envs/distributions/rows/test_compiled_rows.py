"""Compiled rows are those that NumPy finds coordinate by coordinate: maps to the bit, densities up to rounding."""

import numpy as np
import pytest

from rare_envs.distributions.mixture_conditionals import MixtureConditionals
from rare_envs.distributions.rows.box_points import describe_points
from tests.rare_envs.distributions.rows.random_mixtures import CLOSING, draw_box, draw_mixture

pytest.importorskip("numba", reason="compiled rows need numba")

from rare_envs.distributions.rows import compiled_rows

CASES = [(1, 1, 20.0), (1, 6, 20.0), (3, 3, 20.0), (8, 2, 20.0), (8, 6, 5.0), (2, 3, 1e-3), (2, 3, 1e-5)]
"""Components, dimensions and width of the box."""


@pytest.fixture(params=[*CASES, "closing speed"], ids=str)
def mixtures(request: pytest.FixtureRequest) -> list[MixtureConditionals]:
    rng = np.random.default_rng(0)
    components, dim, width = (3, 3, 0.0) if request.param == "closing speed" else request.param
    box = CLOSING if request.param == "closing speed" else draw_box(rng, dim, width)
    return [draw_mixture(rng, box, components, correlated) for correlated in (True, False)]


@pytest.mark.parametrize(("n", "spread"), [(0, 1.0), (1, 1.0), (5000, 1.0), (500, 5.0), (500, 20.0)])
def test_maps_have_the_bits_of_numpy(mixtures: list[MixtureConditionals], n: int, spread: float) -> None:
    """The points with a spread of 20 include some that do not fit into plain numbers."""
    u = spread * np.random.default_rng(n).standard_normal((n, mixtures[0].dim))
    for mixture in mixtures:
        x = mixture._from_normal_by_rows(u, compiled_rows)
        assert np.array_equal(x, mixture._from_normal_by_coordinates(u))


@pytest.mark.parametrize("n", [0, 1, 5000])
def test_densities_are_those_of_numpy(mixtures: list[MixtureConditionals], n: int) -> None:
    rng, box = np.random.default_rng(n), mixtures[0].coordinates
    for mixture in mixtures:
        bulk = mixture.sample(n, rng)
        for x in (bulk, rng.uniform(box.low, box.high, (n, box.dim))):
            points = describe_points(box, x)
            known = mixture._log_prob_by_coordinates(points)
            assert mixture._log_prob_by_rows(points, compiled_rows) == pytest.approx(known, rel=1e-12, abs=1e-12)


def test_a_row_does_not_depend_on_the_others(mixtures: list[MixtureConditionals]) -> None:
    rng = np.random.default_rng(3)
    u = 3.0 * rng.standard_normal((60, mixtures[0].dim))
    u[::7] *= 10.0
    some = rng.permutation(60)[:23]
    for mixture in mixtures:
        x = mixture._from_normal_by_rows(u, compiled_rows)
        assert np.array_equal(x[some], mixture._from_normal_by_rows(u[some], compiled_rows))
        points = describe_points(mixture.coordinates, x)
        whole = mixture._log_prob_by_rows(points, compiled_rows)
        alone = mixture._log_prob_by_rows(describe_points(mixture.coordinates, x[some]), compiled_rows)
        assert np.array_equal(whole[some], alone)


def test_boxes_far_out_are_left_to_logarithms() -> None:
    """The components have masses of exp(-5,000) in the box: no row fits into plain numbers."""
    mixture = draw_mixture(np.random.default_rng(1), draw_box(np.random.default_rng(1), 2, 5.0), 2, True)
    far = MixtureConditionals(mixture.coordinates, mixture.weights, mixture.means - 300.0, mixture.covariances)
    u = np.random.default_rng(2).standard_normal((50, 2))
    x = far._from_normal_by_rows(u, compiled_rows)
    assert np.array_equal(x, far._from_normal_by_coordinates(u))
    points = describe_points(far.coordinates, x)
    assert not compiled_rows.find_log_densities(far._parameters, points.ranges, points.y)[1].any()
    assert not np.isnan(far._log_prob_by_rows(points, compiled_rows)).any()
    assert np.array_equal(far._log_prob_by_rows(points, compiled_rows), far._log_prob_by_coordinates(points))


def test_ends_at_zero_are_kept_off() -> None:
    """The least distance from 0 is that of `move_inside`."""
    mixture = draw_mixture(np.random.default_rng(4), CLOSING, 2, True)
    low = MixtureConditionals(CLOSING, mixture.weights, mixture.means - [60.0, 0.0, 0.0], mixture.covariances)
    u = np.full((4, 3), -29.0)
    assert np.array_equal(low._from_normal_by_rows(u, compiled_rows), low._from_normal_by_coordinates(u))
