"""Compiled crashes against their torch twins, at random contacts of three vehicles and at rest."""

import numpy as np
import pytest
import torch

from rare_envs.fast import crashes as fast_crashes
from rare_envs.fast.equations import RoadNumbers
from rare_envs.simulation.episode import EpisodeStatistics
from rare_envs.traffic import crash, straight
from rare_envs.traffic.bodies import ego_overlaps, others_overlap
from rare_envs.traffic.state import State

N, ROAD, DT = 2000, straight(2), np.float32(0.1)


def tick(turned: float, speed: float) -> tuple[State, State]:
    """Three vehicles near each other before and after a tick, headings up to `turned` and some of them at rest."""
    rng = np.random.default_rng(3)
    ranges = ((0, 12), (-3, 7), (-turned, turned), (0, speed))
    x, y, heading, speeds = (torch.from_numpy(rng.uniform(low, high, (N, 3))).float() for low, high in ranges)
    speeds = speeds * torch.from_numpy(rng.random((N, 3)) < 0.8)
    after = State(x, y, heading, speeds, theta=x[:, :0])
    along, across = speeds * torch.cos(heading) * 0.1, speeds * torch.sin(heading) * 0.1
    return State(x - along, y - across, heading - 0.01, speeds, theta=x[:, :0]), after


def nothing() -> crash.Crash:
    return crash.Crash.nothing(torch.zeros(N))


def copied(crashes: crash.Crash) -> fast_crashes.CrashRows:
    return fast_crashes.CrashRows(*(field.numpy().copy() for field in crashes))


@pytest.mark.parametrize(("turned", "speed"), [(0.0, 30.0), (0.2, 30.0), (1.5, 10.0), (0.1, 0.0)])
def test_crashes_are_those_of_torch(turned, speed):
    before, after = tick(turned, speed)
    now = ego_overlaps(after, ROAD).any(1) | ROAD.off_road(after.y[:, 0])
    rng = np.random.default_rng(1)
    over, known = (torch.from_numpy(rng.random(N) < 0.2) for _ in range(2))
    now = now | over
    old = nothing().replace_where(known, crash.crash_of_others(after, ROAD))
    rows = (now & ~over, others_overlap(after, ROAD) & (old.kind == crash.NONE) & ~over)
    expected = EpisodeStatistics(
        torch.zeros(N),
        nothing().replace_where(rows[0], crash.crash_of(after, ROAD, before, 0.1)),
        old.replace_where(rows[1], crash.crash_of_others(after, ROAD, before, 0.1)),
    )
    own, others = copied(nothing()), copied(old)
    stacked = (np.stack([field.numpy().T for field in state[:4]]) for state in (before, after))
    fast_crashes.record_crashes(*stacked, over.numpy(), now.numpy(), RoadNumbers.of(ROAD), DT, own, others)
    for found, wanted in ((own, expected.own), (others, expected.others)):
        assert np.array_equal(found.kind, wanted.kind.numpy())
        assert np.array_equal(found.vehicles, wanted.vehicles.numpy())
        for value, other in zip(found[2:], wanted[2:], strict=True):
            assert np.allclose(value, other.numpy(), rtol=1e-4, atol=1e-4)
    kinds = set(np.unique(own.kind).tolist())
    assert kinds >= {crash.NONE, crash.REAR_END, crash.REAR_ENDED, crash.SIDE, crash.ROAD_EDGE}
    assert set(np.unique(others.kind).tolist()) == {crash.NONE, crash.OTHERS}
