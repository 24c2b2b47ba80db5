"""The cut-in: its path, its duration, a cutter that minds its lead, and the bases of the second version."""

from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
import torch

import rare_envs
from rare_envs.distributions.coordinates import Coordinates
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.mixture import CoordinateMixture
from rare_envs.scenarios.base_distributions import load_base
from rare_envs.scenarios.cut_in import CUT_IN, CUT_IN_DURATION, TIMED_CUT_IN, bezier
from rare_envs.simulation.world import World
from tests.rare_envs.traffic_states import F64, tensor


def test_bezier_is_de_casteljau_and_level_at_both_ends() -> None:
    length, offset = 60.0, 3.5
    control = [(0.0, offset), (length / 3, offset), (2 * length / 3, 0.0), (length, 0.0)]
    for t in (0.0, 0.2, 0.5, 0.9, 1.0):
        points = control
        while len(points) > 1:
            points = [((1 - t) * a[0] + t * b[0], (1 - t) * a[1] + t * b[1]) for a, b in pairwise(points)]
        y, slope = bezier(tensor(t * length), tensor(length), tensor(offset))
        assert y.item() == pytest.approx(points[0][1], abs=1e-14)
        eps = 1e-6
        if 0.0 < t < 1.0:
            ahead, behind = (bezier(tensor(t * length + e), tensor(length), tensor(offset))[0] for e in (eps, -eps))
            assert slope.item() == pytest.approx((ahead - behind).item() / (2 * eps), abs=1e-8)
        else:
            assert slope.item() == 0.0


def test_cutter_arrives_in_the_lane_and_minds_its_lead() -> None:
    world = World(CUT_IN)
    episode = world.start(tensor(10.0, 20.0, 12.0, 40.0, 25.0, 3.5)[None])
    for _ in range(world.clock.ticks):
        episode = world.step(episode, torch.zeros(1, 2, dtype=F64))
    state = episode.state
    assert state.y[0, 1].item() == 0.0
    assert state.heading[0, 1].item() == 0.0
    assert state.x[0, 2] - state.x[0, 1] > 5.0  # 8 m/s faster than the lead at first, and still behind it
    assert state.speed[0, 2].item() == 12.0


def drive_straight(duration: float, offset: float = 3.0, speed: float = 30.0, dt: float = 0.05) -> torch.Tensor:
    """Return y of a cutter that keeps its speed, at each tick from the start on."""
    state = TIMED_CUT_IN.initial(tensor(20.0, speed, 25.0, 40.0, 60.0, offset, duration)[None])
    found = [state.y[0, 1]]
    for _ in range(round(1.5 * duration / dt)):
        after = TIMED_CUT_IN.driven(state, torch.zeros(1, 2, 2, dtype=F64), dt)
        moved = {name: torch.cat([getattr(state, name)[:, :1], getattr(after, name)], 1) for name in after._fields}
        state = state._replace(**moved)
        found.append(state.y[0, 1])
    return torch.stack(found)


@pytest.mark.parametrize("duration", [2.0, 4.0, 7.5])
def test_a_change_takes_its_duration_and_crosses_the_marking_in_its_middle(duration: float) -> None:
    """y = offset (1 - 3 s^2 + 2 s^3) with s = t / duration: half way across at s = 1/2, by a fifth at s = 0.287.

    Along the road the cutter is slower by the cosine of its heading: by 0.0014 in the mean at 2 s (a slope of
    1.5 x 3 m / 60 m at most), less in longer changes.
    """
    dt = 0.05
    y = drive_straight(duration, dt=dt)
    t = dt * torch.arange(len(y), dtype=F64)
    s = (t / duration).clamp(max=1.0)
    assert (y - 3.0 * (1.0 - 3.0 * s**2 + 2.0 * s**3)).abs().max() < 3.0 * 1.5 * 0.0015
    crossing = t[y <= 1.5][0].item()
    assert duration / 2 <= crossing <= duration / 2 * 1.0015 + dt
    assert t[y <= 0.8 * 3.0][0].item() == pytest.approx(0.287 * duration, abs=dt + 0.001 * duration)
    assert y[-1].item() == 0.0


def test_four_seconds_are_the_first_version_to_the_bit() -> None:
    first, second = (rare_envs.DrivingProblem(f"rare_envs/CutIn-v{version}", base="us101") for version in (0, 1))
    assert first.space.names == second.space.names[:6]
    x = rare_envs.DrivingProblem("rare_envs/CutIn-v0", base="i80").base.sample(400, np.random.default_rng(2))
    f = first.evaluate(x)
    assert (second.evaluate(np.column_stack([x, np.full(400, CUT_IN_DURATION)])) == f).all()
    slow, fast = (second.evaluate(np.column_stack([x, np.full(400, seconds)])) for seconds in (8.0, 2.0))
    assert (slow <= 0.0).sum() > (f <= 0.0).sum() > (fast <= 0.0).sum() > 0


def test_both_versions_stand_beside_each_other() -> None:
    """An id without a version is that of the newest."""
    for env_id in ("rare_envs/CutIn-v0", "rare_envs/CutIn-v1", "rare_envs/CutIn-kinematics-v0"):
        assert gym.make(env_id).spec.id == env_id  # type: ignore[union-attr]
    with pytest.warns(UserWarning, match="Using the latest versioned environment `rare_envs/CutIn-v1`"):
        assert gym.make("rare_envs/CutIn").spec.id == "rare_envs/CutIn-v1"  # type: ignore[union-attr]
    _, info = gym.make("rare_envs/CutIn-v1").reset(seed=0, options={"duration": 7.0})
    assert info["scenario"]["duration"] == 7.0
    with pytest.raises(ValueError, match=r"duration = 13.* is outside its range \[1.5, 12\] s"):
        gym.make("rare_envs/CutIn-v1").reset(options={"duration": 13.0})


# --- bases of the second version ------------------------------------------------------------------


def shape_block(name: str) -> tuple[FittedDistribution, CoordinateMixture]:
    """Return a base, and its lateral offset and duration by themselves: they are independent of the other columns."""
    base = load_base(TIMED_CUT_IN, name)
    assert isinstance(base, FittedDistribution)
    whole = base.distribution
    assert isinstance(whole, CoordinateMixture)
    covariance = whole.covariances[0]
    assert len(whole.weights) == 1 and (covariance[5:, :5] == 0.0).all() and covariance[5, 6] > 0.0
    coordinates = Coordinates(whole.low[5:], whole.high[5:], whole.coordinates.kinds[5:])
    return base, CoordinateMixture(coordinates, [1.0], [whole.means[0][5:]], [covariance[5:, 5:]])


@pytest.mark.parametrize("name", ["us101", "us101-closing", "i80", "i80-closing"])
def test_the_density_of_offset_and_duration_integrates_to_one(name: str) -> None:
    base, shape = shape_block(name)
    nodes, weights = np.polynomial.legendre.leggauss(60)
    half = 0.5 * (shape.high - shape.low)
    offset, duration = (low + part * (nodes + 1.0) for low, part in zip(shape.low, half, strict=True))
    grid = np.stack(np.meshgrid(offset, duration, indexing="ij"), axis=-1).reshape(-1, 2)
    log_p = shape.log_prob(grid)
    assert (np.exp(log_p) * np.outer(weights, weights).ravel()).sum() * half.prod() == pytest.approx(1.0, abs=1e-9)
    others = base.sample(1, np.random.default_rng(0))[0, :5]
    whole = base.log_prob(np.column_stack([np.tile(others, (len(grid), 1)), grid]))
    np.testing.assert_allclose(whole - whole[0], log_p - log_p[0], atol=1e-9)


@pytest.mark.parametrize("name", ["us101", "i80"])
def test_drawn_durations_have_the_fitted_distribution(name: str) -> None:
    """Kolmogorov-Smirnov: 0.025 is exceeded by 5,000 draws with a probability of 4e-3."""
    base, shape = shape_block(name)
    duration = np.sort(base.sample(5000, np.random.default_rng(5))[:, 6])
    grid = np.linspace(shape.low[1], shape.high[1], 400)
    offsets, weights = np.polynomial.legendre.leggauss(40)
    offsets = shape.low[0] + 0.5 * (shape.high[0] - shape.low[0]) * (offsets + 1.0)
    density = sum(
        w * np.exp(shape.log_prob(np.column_stack([np.full(400, o), grid])))
        for o, w in zip(offsets, 0.5 * (shape.high[0] - shape.low[0]) * weights, strict=True)
    )
    cdf = np.append(0.0, np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(grid)))
    assert cdf[-1] == pytest.approx(1.0, abs=1e-4)
    expected = np.interp(duration, grid, cdf)
    assert np.abs(expected - (np.arange(5000) + 0.5) / 5000).max() < 0.025


@pytest.mark.parametrize("name", ["us101", "i80"])
def test_refits_move_offset_and_duration_as_few_changes_do(name: str) -> None:
    """The mean of n changes has the standard deviation sd / sqrt(n); that of 30 refits is off by a seventh of it."""
    base, shape = shape_block(name)
    assert len(base.refits) == 30
    means = np.array([refit.means[0][5:] for refit in base.refits])  # type: ignore[attr-defined]
    expected = np.sqrt(np.diag(shape.covariances[0]) / base.events.used[1])
    assert (np.abs(means.std(axis=0, ddof=1) / expected - 1.0) < 3.0 / np.sqrt(2 * 29)).all()
    u = base.to_standard_normal(base.sample(1000, np.random.default_rng(1)))
    assert abs(np.corrcoef(u[:, 5], u[:, 6])[0, 1]) < 4.0 / np.sqrt(1000)  # the map takes the correlation out
