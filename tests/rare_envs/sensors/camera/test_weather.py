"""Weather: its distributions, what it does to pictures, and that all of it is in x."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import Tensor

import rare_envs
from rare_envs.sensors.camera import CONDITIONS, SENSOR_NOISE, Camera, CameraContext, Weather
from rare_envs.sensors.pictures import take_picture
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import State

CUT_IN, HIGHWAY = "rare_envs/CutIn-v0", "rare_envs/Highway-v0"


def shots(**sky: Any) -> Tensor:
    """A car 25 m ahead in pictures of different weather, shape (B, H, W, 3), in floating point."""
    usual = {"fog": 1.5e-4, "sun_elevation": 0.8, "sun_azimuth": 2.0, "noise": 0.0, "key": 0}
    batch = len(next(iter(sky.values())))
    columns = {name: torch.as_tensor(sky.get(name, [value] * batch)) for name, value in usual.items()}
    x = torch.tensor([[0.0, 25.0]]).repeat(batch, 1)
    state = State(x, torch.zeros_like(x), torch.zeros_like(x), torch.zeros_like(x), x[:, :0])
    weather = Weather(**{name: column.long() if name == "key" else column.float() for name, column in columns.items()})
    return take_picture(state, straight(3), CameraContext.at_start(Camera(), weather)).float()


def test_noise_is_as_strong_as_it_says_and_grows_with_it() -> None:
    clean, *noisy = shots(noise=[0.0, 2.0, 8.0], key=[5, 5, 5])
    for level, image in zip((2.0, 8.0), noisy, strict=True):
        difference = (image - clean)[clean.clamp(40, 215) == clean]
        assert float(difference.std()) == pytest.approx(math.hypot(level, math.sqrt(1 / 12)), rel=0.03)
        assert abs(float(difference.mean())) < 0.1


def test_on_the_highway_weather_stands_before_the_drivers_and_all_noise_behind() -> None:
    problem = rare_envs.DrivingProblem(HIGHWAY, weather=True, observation="camera")
    conditions = [p.name for p in (*CONDITIONS, SENSOR_NOISE)]
    assert list(problem.space.names)[4:] == [*conditions, "weights", "noise", "camera_noise"]
    x = problem.base.sample(2, np.random.default_rng(0))
    parts = problem.space.columns(x)
    without = rare_envs.DrivingProblem(HIGHWAY)
    same = np.column_stack([parts[name] for name in without.space.names])
    np.testing.assert_array_equal(problem.evaluate(x), without.evaluate(same))  # an ego that does not look at it
    episode = problem.world.start(torch.from_numpy(x).float())
    assert episode.camera_context is not None
    np.testing.assert_allclose(episode.camera_context.weather.fog, parts["fog"], rtol=1e-6)
    np.testing.assert_allclose(
        torch.rad2deg(episode.camera_context.weather.sun_azimuth), parts["sun_azimuth"], rtol=1e-6
    )
    np.testing.assert_allclose(episode.camera_context.weather.noise, parts["sensor_noise"], rtol=1e-6)


def test_weather_is_a_reset_option() -> None:
    env = gym.make(CUT_IN, observation="camera", weather=True)
    clear, _ = env.reset(seed=0, options={"fog": 1e-4, "sensor_noise": 0.0})
    foggy, info = env.reset(seed=0, options={"fog": 0.1, "sensor_noise": 0.0})
    assert info["scenario"]["fog"] == 0.1
    assert foggy.std() < 0.5 * clear.std()
    with pytest.raises(ValueError, match="weather"):
        gym.make(CUT_IN, weather="foggy")


def test_noise_follows_from_its_column_and_the_tick_alone() -> None:
    env = gym.make(CUT_IN, observation="camera", weather=True)
    first, info = env.reset(seed=3, options={"sensor_noise": 8.0})
    x = info["x"]
    again, _ = env.reset(options={"x": x})
    np.testing.assert_array_equal(first, again)
    other = x.copy()
    other[-1] += 0.1  # camera_noise
    different, _ = env.reset(options={"x": other})
    assert (different != first).mean() > 0.8
    assert abs(different.astype(float) - first).max() < 80
    fixed = gym.make(CUT_IN, observation="camera", weather=True, noise="fixed")
    image, _ = fixed.reset(options={"x": x[:-1]})
    same, _ = fixed.reset(seed=9, options={"x": x[:-1]})
    np.testing.assert_array_equal(image, same)
    assert (image != first).mean() > 0.8
