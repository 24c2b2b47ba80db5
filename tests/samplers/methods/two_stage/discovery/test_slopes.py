"""Directions in which f changes, where they are known: of planes, of a shell, of f that is flat within failure."""

import numpy as np
import pytest

from samplers.methods.two_stage.discovery.slopes import find_slopes
from samplers.methods.two_stage.regions import ExplorationResult, Region
from samplers.methods.two_stage.settings import SlopeSettings
from samplers.methods.two_stage.simulator import Simulator
from samplers.problem import FunctionProblem

SETTINGS = SlopeSettings()
ROOM = 3300
HIGH_DIM = 40


def region_of(problem, centre, rng, chains=40):
    """Failing points around a centre as chains of one step, and those that do not fail as what is beside them."""
    u = np.asarray(centre) + rng.standard_normal((100 * chains, problem.dim))
    f = problem.evaluate(u)
    inside, outside = u[f <= 0][:chains], f > 0
    assert len(inside) == chains
    return Region(inside[:, None], u[outside][:200], f[outside][:200])


def slopes_of(f, dim, centre, rng, drive, room=ROOM, **flags):
    """Return the directions, and the number of simulations."""
    problem = FunctionProblem(f, dim)
    exploration = ExplorationResult([region_of(problem, centre, rng)], **{"noisy": False, **flags})
    simulator = Simulator(problem)
    axes, made = drive(find_slopes(simulator, exploration, 0.0, room, rng, SETTINGS, HIGH_DIM), problem)
    assert simulator.n_sim == len(made)
    return axes, simulator.n_sim


def holds(axes, vectors):
    """Return whether unit vectors (k, d) lie in the span of orthonormal axes (d, r)."""
    return np.linalg.norm(np.atleast_2d(vectors) @ axes, axis=1) == pytest.approx(1.0, abs=1e-6)


def test_three_of_forty_coordinates_that_must_all_be_large(rng, drive):
    f = lambda u: np.max([1.9 - u[:, 7], 1.7 - u[:, 19], 1.5 - u[:, 33]], axis=0)  # noqa: E731
    axes, n_sim = slopes_of(f, 40, 2.0 * np.isin(np.arange(40), [7, 19, 33]), rng, drive)
    assert axes.shape == (40, 3)
    assert holds(axes, np.eye(40)[[7, 19, 33]])
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert (
        n_sim == 13 * 41 <= SETTINGS.share * ROOM
    )  # of 17: the third batch is not made where the second was explained


@pytest.mark.parametrize("flat", ["inside", "beside"])
def test_one_direction_is_found_where_f_is_flat_on_one_side(flat, rng, drive):
    normal = np.arange(1.0, 21.0) / np.linalg.norm(np.arange(1.0, 21.0))

    def f(u):
        g = 3.0 - u @ normal
        return np.where(g <= 0, -1.0, g) if flat == "inside" else np.minimum(g, 0.5)

    axes, _ = slopes_of(f, 20, 2.5 * normal, rng, drive)
    assert holds(axes, normal)


def test_a_shell_has_no_few_directions(rng, drive):
    """The search ends after half of the gradients."""
    axes, n_sim = slopes_of(lambda u: 5.5 - np.linalg.norm(u, axis=1), 20, np.zeros(20), rng, drive)
    assert axes is None
    assert n_sim == 10 * 21


def test_no_point_is_taken_twice(rng, drive):
    """Ends of chains and points beside a ring; those that known directions explain least are others each time."""
    made = []

    def ring(u):
        if len(u) < 2000:
            made.append(u[: len(u) // 31])  # the points, before those beside each
        return 3.5 - np.hypot(u[:, 0], u[:, 1])

    slopes_of(ring, 30, 3.5 * np.eye(30)[0], rng, drive, scattered=True)
    points = np.concatenate(made)
    assert len(made) >= 2
    assert len(np.unique(points, axis=0)) == len(points) > 10


def test_a_plane_is_found_where_failure_is_flat(rng, drive):
    """-1 on failure: gradients are made beside the ring only."""

    def f(u):
        r = np.hypot(u[:, 0], u[:, 1])
        return np.where(r >= 3.5, -1.0, 3.5 - r)

    axes, _ = slopes_of(f, 30, 3.3 * np.eye(30)[0], rng, drive)
    assert holds(axes, np.eye(30)[:2])


def test_the_gradient_of_a_curved_f_is_right_to_half_a_step(rng, drive):
    """f = 3 - u_1 + 0.1 u_2^2 at u_2 near 1: the difference over 0.05 is 0.1 (2 u_2 + 0.05)."""
    axes, _ = slopes_of(lambda u: 3.0 - u[:, 0] + 0.1 * u[:, 1] ** 2, 15, 2.5 * np.eye(15)[0], rng, drive)
    assert holds(axes, np.eye(15)[:2])


@pytest.mark.parametrize(
    ("dim", "room", "flags"),
    [
        (14, ROOM, {}),  # chains show as much
        (30, 300, {}),  # two gradients
        (30, ROOM, {"noisy": True}),
    ],
)
def test_no_simulation_is_spent_where_gradients_are_no_use(dim, room, flags, rng, drive):
    axes, n_sim = slopes_of(lambda u: 2.0 - u[:, 0], dim, 2.0 * np.eye(dim)[0], rng, drive, room, **flags)
    assert axes is None
    assert n_sim == 0


@pytest.mark.parametrize(
    ("dim", "flags", "most"), [(30, {}, 20), (60, {}, 16), (150, {}, 6), (30, {"scattered": True}, 20)]
)
def test_a_plane_is_found_for_a_share_of_the_budget(dim, flags, most, rng, drive):
    """f falls along another direction at every point of a ring; 30 % of what is left at most, in 40 or fewer 22 %."""
    ring = lambda u: 3.5 - np.hypot(u[:, 0], u[:, 1])  # noqa: E731
    axes, n_sim = slopes_of(ring, dim, 3.5 * np.eye(dim)[0], rng, drive, **flags)
    assert n_sim <= most * (dim + 1)
    assert holds(axes, np.eye(dim)[:2])
