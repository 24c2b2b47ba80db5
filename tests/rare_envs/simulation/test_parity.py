"""Our world against HighwayEnv's own objects, float64, before contact; and where we differ on purpose."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from highway_env.road.road import Road
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import NDArray

from benchmarks.simulation import highway_env_reference as reference
from rare_envs.control.idm import IDM
from rare_envs.scenarios.base import Scenario
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.scenarios.cut_in import CUT_IN
from rare_envs.simulation.world import World
from rare_envs.traffic.state import bicycle

TOLERANCE = 1e-9
TICKS = 120

Array = NDArray[np.float64]


def drive(scenario: Scenario, idm: IDM, x: Array) -> tuple[Array, Array]:
    """x, y, heading, speed at times 0 to `TICKS`, shape (n, TICKS + 1, N, 4), and whether collided by then."""
    world = World(scenario)
    episode, rows, collided = world.start(torch.from_numpy(x)), [], []
    for _ in range(TICKS + 1):
        state = episode.state
        rows.append(torch.stack((state.x, state.y, state.heading, state.speed), dim=-1))
        collided.append(episode.collided)
        episode = world.step(episode, idm.act(episode, None)[0])
    return torch.stack(rows, dim=1).numpy(), torch.stack(collided, dim=1).numpy()


def points(low: list[float], high: list[float], n: int) -> Array:
    return np.random.default_rng(7).uniform(low, high, (n, len(low)))


CAR_FOLLOWING_X = points([10, 2, 4], [30, 20, 50], 30)
CUT_IN_X = np.concatenate(
    [
        points([8, 6, 6, 3, 8, 2.5], [25, 25, 25, 40, 50, 4.5], 24),
        points([4, 0, 4, 3, 8, 2.5], [10, 4, 12, 40, 50, 4.5], 8),  # paths of the least length
    ]
)


@pytest.mark.parametrize(
    ("scenario", "road", "x"),
    [(CAR_FOLLOWING, reference.car_following_road, CAR_FOLLOWING_X), (CUT_IN, reference.cut_in_road, CUT_IN_X)],
    ids=["car_following", "cut_in"],
)
@pytest.mark.parametrize(
    ("ego", "idm"),
    [(IDMVehicle, IDM.highway_env(25.0)), (reference.TianVehicle, IDM(desired_speed=25.0))],
    ids=["highway_env", "tian"],
)
def test_closed_loop(scenario: Scenario, road: Callable[..., Road], x: Array, ego: type[IDMVehicle], idm: IDM) -> None:
    compared = collisions = 0
    for row, ours, collided in zip(x, *drive(scenario, idm, x), strict=True):
        theirs, crashed = reference.drive_road(road(row, ego, 25.0), TICKS)
        before = len(theirs) if not collided.any() else min(len(theirs), int(collided.argmax()))
        standing = theirs[:before, 0, 3] <= 0.0
        before = int(standing.argmax()) if standing.any() else before  # from there HighwayEnv reverses
        assert np.abs(ours[:before] - theirs[:before]).max() < TOLERANCE
        compared += before
        if crashed and not standing.any():
            collisions += 1
            # HighwayEnv flags a hit that it foresees a tick early, or a tick late after pushing the vehicles apart
            assert abs(int(collided.argmax()) - len(theirs)) <= 1
            assert collided.any()
    assert compared > 0.5 * len(x) * TICKS
    assert collisions >= 3


def test_open_loop_bicycle() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        vehicle = Vehicle(None, [0.0, 0.0], rng.uniform(-0.3, 0.3), 20.0)
        state = tuple(torch.tensor([v], dtype=torch.float64) for v in (0.0, 0.0, vehicle.heading, 20.0))
        for _ in range(100):
            acceleration, steering = rng.uniform(-1.0, 1.5), rng.uniform(-0.1, 0.1)
            vehicle.act({"acceleration": acceleration, "steering": steering})
            vehicle.step(0.1)
            action = torch.tensor([[acceleration], [steering]], dtype=torch.float64)
            state = bicycle(*state, action[0], action[1], 0.1)
        theirs = [*vehicle.position, vehicle.heading, vehicle.speed]
        assert np.abs(np.array(theirs) - torch.cat(state).numpy()).max() < TOLERANCE


def test_difference_vehicles_stop_where_highway_env_reverses() -> None:
    x = np.array([3.0, 0.0, 6.0])
    theirs, _ = reference.drive_road(reference.car_following_road(x, IDMVehicle, 25.0), TICKS)
    ours, _ = drive(CAR_FOLLOWING, IDM.highway_env(25.0), x[None])
    assert theirs[:, 0, 3].min() < 0.0
    assert ours[0, :, 0, 3].min() == 0.0
