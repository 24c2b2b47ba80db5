"""Pictures and HighwayEnv's objects: who is painted how, the numbers above, windows and videos."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch

import rare_envs
from rare_envs.envs.rendering import (
    CRASH_COLOUR,
    FRAME_WIDTH,
    ROLE_COLOURS,
    SIGNAL,
    TEXT_HEIGHT,
    Renderer,
    as_rgb,
    caption,
    make_network,
    make_scene,
    make_traffic,
    world_point,
)
from rare_envs.make import set_up
from rare_envs.scenarios.registry import SCENARIOS
from rare_envs.traffic.road import i80
from rare_envs.traffic.state import State

every = pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)
CUT_IN = "rare_envs/CutIn-v0"


def road_of(image):
    return image[TEXT_HEIGHT:-TEXT_HEIGHT]


def colours(image):
    return {tuple(each) for each in np.unique(image.reshape(-1, 3), axis=0).tolist()}


@every
def test_every_vehicle_has_the_colour_of_its_role(env_id):
    env = gym.make(env_id, render_mode="rgb_array")
    env.reset(seed=0)
    image = env.render()
    scenario = SCENARIOS[env_id]
    height = max(160, 16 * round((scenario.road.lanes * scenario.road.width + 8) / 2))
    assert (image.shape, image.dtype) == ((height + 2 * TEXT_HEIGHT, FRAME_WIDTH, 3), np.uint8)
    roles = {name if name in ROLE_COLOURS else "others" for name in scenario.vehicle_names}
    assert {as_rgb(ROLE_COLOURS[role]) for role in roles} <= colours(road_of(image))
    assert colours(image[:TEXT_HEIGHT]) > {(255, 255, 255)}  # text
    env.close()


def test_the_picture_shows_where_vehicles_are_and_who_has_crashed():
    world, _ = set_up(CUT_IN)
    renderer = Renderer(world)
    x = torch.tensor([[20.0, 20.0, 20.0, 10.0, 12.0, 4.0], [20.0, 5.0, 5.0, 1.0, 30.0, 2.2]])
    episode = world.start(x)
    for _ in range(25):
        episode = world.step(episode, torch.tensor([[0.0, 0.0], [5.0, 0.0]]))
    assert episode.collided.tolist() == [False, True]
    image = road_of(renderer.draw(episode))
    for j, role in enumerate(("ego", "cutter", "lead")):
        ahead = float(episode.state.x[0, j] - episode.state.x[0, 0])
        across = float(episode.state.y[0, j]) - world.scenario.road.middle
        assert tuple(image[round(80 + 8 * across), round(240 + 8 * ahead)]) == as_rgb(ROLE_COLOURS[role])
    crashed = colours(road_of(renderer.draw(episode, row=1)))
    assert as_rgb(CRASH_COLOUR) in crashed and as_rgb(CRASH_COLOUR) not in colours(image)
    assert {as_rgb(ROLE_COLOURS[role]) for role in ("ego", "lead")} <= crashed  # each is still who it is


def test_indicators_are_shown_until_the_change_is_over_and_not_of_vehicles_that_agents_drive():
    world, _ = set_up("rare_envs/CutIn-v1")
    x = torch.tensor([[20.0, 20.0, 20.0, 10.0, 60.0, 3.5, 4.0, 0.0, 0.0, z, 9.0, 0.0, 0.0] for z in (0.0, -1.0)])
    renderer, start = Renderer(world), world.start(x)
    over = start
    for _ in range(45):
        over = world.step(over, torch.zeros(2, 2))
    on, off, late = (
        colours(road_of(renderer.draw(each, row=row))) for each, row in ((start, 0), (start, 1), (over, 0))
    )
    assert SIGNAL in on and SIGNAL not in off | late
    assert SIGNAL not in colours(road_of(renderer.draw(start, agents=[1])))


def test_the_numbers_in_the_picture_by_hand():
    world, _ = set_up("rare_envs/CarFollowing-v0")
    episode = world.start(torch.tensor([[20.0, 15.0, 14.5], [20.0, 25.0, 30.0]]))
    assert caption(world, episode, 0.0) == (
        " 0.0 s    ego 20.0 m/s    gap  14.5 m    time to collision  2.9 s    closest so far 2.9 s"
    )
    assert caption(world, episode, 0.0, row=1) == " 0.0 s    ego 20.0 m/s    gap  30.0 m"
    world, _ = set_up("rare_envs/CarFollowing-v0", measure=lambda moment: moment.lead.gap)
    episode = world.start(torch.tensor([[20.0, 15.0, 14.5]]))
    assert caption(world, episode, None).endswith("f so far 14.50")


@pytest.mark.parametrize("mode", [None, "rgb_array", "human"])
def test_nothing_to_render_is_a_warning(mode, monkeypatch):
    world, warned = set_up("rare_envs/CarFollowing-v0")[0], []
    episode = world.start(torch.tensor([[20.0, 20.0, 30.0]]))
    monkeypatch.setattr(gym.logger, "warn", warned.append)
    assert Renderer(world, mode).render(episode if mode is None else None, 0.0) is None
    assert len(warned) == 1 and "Nothing to render" in warned[0]


def test_a_curved_road_has_a_lane_for_each_lane_along_its_pieces() -> None:
    road = i80()
    network = make_network(road, 300.0)
    pieces = {index[:2] for index in network.lanes_dict()}
    assert len(pieces) == 7 and len(network.lanes_list()) == 7 * road.lanes
    for lane in range(road.lanes):
        point = world_point(road, 310.0, road.centre(lane))
        assert network.get_closest_lane_index(point)[2] == lane
    zero = torch.zeros(1, 1)
    state = State(zero + 310.0, zero + road.centre(2), zero, zero, zero[:, :0])
    (vehicle,) = make_traffic(state, road).vehicles
    np.testing.assert_allclose(vehicle.position, world_point(road, 310.0, road.centre(2)), atol=1e-3)


def test_who_touches_the_ego_has_crashed_and_targets_are_those_of_its_controller() -> None:
    world, _ = set_up("rare_envs/CarFollowing-v0", action="meta")
    apart, touching = torch.tensor([[21.0, 15.0, 30.0]]), torch.tensor([[38.0, 2.0, 1.0]])
    scene = make_scene(world.start(apart))
    assert [vehicle.crashed for vehicle in scene.vehicles] == [False, False]
    assert (scene.vehicles[0].target_speed, scene.vehicles[0].target_lane_index) == (20.0, ("0", "1", 0))
    episode = world.start(touching)
    for _ in range(3):
        episode = world.step(episode, torch.zeros(1, 2))
    assert bool(episode.collided)
    assert [vehicle.crashed for vehicle in make_scene(episode).vehicles] == [True, True]
