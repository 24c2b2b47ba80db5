"""Display of an environment: render modes, and what is shown before the first episode."""

import gymnasium as gym
import numpy as np
import pytest
import torch

import rare_envs
from rare_envs.envs.rendering import Display, Renderer


@pytest.fixture(scope="module")
def world():
    return rare_envs.DrivingProblem("rare_envs/CarFollowing-v0").world


@pytest.fixture(scope="module")
def episode(world):
    return world.start(torch.tensor([[20.0, 20.0, 30.0]]))


def test_an_image_is_that_of_the_renderer(world, episode):
    display = Display(world, "rgb_array")
    image = display.draw(episode, 0.5, agents=[1], crashed=[0])
    np.testing.assert_array_equal(image, Renderer(world).draw(episode, 0.5, agents=[1], crashed=[0]))
    assert not np.array_equal(image, display.draw(episode, 0.5))
    display.close()
    np.testing.assert_array_equal(image, display.draw(episode, 0.5, agents=[1], crashed=[0]))  # opens again


@pytest.mark.parametrize("mode", [None, "rgb_array", "human"])
def test_nothing_to_render_is_a_warning(world, episode, mode, monkeypatch):
    warned = []
    monkeypatch.setattr(gym.logger, "warn", warned.append)
    assert Display(world, mode).draw(episode if mode is None else None, 0.0) is None
    assert len(warned) == 1 and "Nothing to render" in warned[0]


def test_a_window_gives_no_image(world, episode, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    display = Display(world, "human")
    assert display.is_window and display.draw(episode, 0.0) is None
    display.close()


def test_an_unknown_mode_is_refused(world):
    with pytest.raises(ValueError, match="Expected render_mode None, 'rgb_array' or 'human', got 'ansi'"):
        Display(world, "ansi")
