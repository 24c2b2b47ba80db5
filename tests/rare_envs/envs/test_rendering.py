"""Pictures: who is painted how, the numbers above, windows and videos."""

import importlib.util

import gymnasium as gym
import numpy as np
import pytest
import torch

import rare_envs
from rare_envs.envs.rendering import AGENT, FRAME_WIDTH, TEXT_HEIGHT, Renderer, caption
from rare_envs.make import set_up
from rare_envs.scenarios.registry import SCENARIOS
from rare_envs.traffic.palette import CRASH_COLOUR, ROLE_COLOURS, as_rgb

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


def test_agents_are_outlined():
    env = rare_envs.parallel_env(CUT_IN, agents=["ego", "cutter"], render_mode="rgb_array")
    env.reset(seed=0)
    assert AGENT in colours(road_of(env.render()))
    alone = rare_envs.parallel_env(CUT_IN, agents=["ego"], render_mode="rgb_array")
    alone.reset(seed=0)
    assert AGENT not in colours(alone.render())


def test_the_numbers_in_the_picture_by_hand():
    world, _ = set_up("rare_envs/CarFollowing-v0")
    episode = world.start(torch.tensor([[20.0, 15.0, 14.5], [20.0, 25.0, 30.0]]))
    assert caption(world, episode, 0.0) == (
        " 0.0 s    ego 20.0 m/s    gap  14.5 m    TTC  2.9 s    f so far (ttc) 2.90"
    )
    assert "TTC   - " in caption(world, episode, 0.0, row=1)
    world, _ = set_up("rare_envs/CarFollowing-v0", measure=lambda moment: moment.lead.gap)
    episode = world.start(torch.tensor([[20.0, 15.0, 14.5]]))
    assert caption(world, episode, None).endswith("f so far 14.50")


@every
def test_a_window(env_id, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make(env_id, render_mode="human", horizon=1.0)
    env.metadata["render_fps"] = 1000
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert env.render() is None
    env.close()


def test_pictures_of_a_batch():
    batch = gym.make_vec(CUT_IN, num_envs=3, render_mode="rgb_array")
    batch.reset(options={"cut_in_gap": np.array([5.0, 20.0, 40.0])})
    images = batch.render()
    assert len(images) == 3
    assert not np.array_equal(images[0], images[1])


@pytest.mark.skipif(importlib.util.find_spec("moviepy") is None, reason="Gymnasium's RecordVideo needs moviepy")
@pytest.mark.filterwarnings("ignore:invalid escape sequence")  # in moviepy 1's own text, when it is first compiled
def test_gymnasium_records_a_video(tmp_path):
    env = gym.wrappers.RecordVideo(gym.make(CUT_IN, render_mode="rgb_array", horizon=1.0), str(tmp_path / "films"))
    env.reset(seed=0)
    for _ in range(10):
        env.step(env.action_space.sample())
    env.close()
    (film,) = tmp_path.glob("films/*.mp4")
    assert film.stat().st_size > 1000
