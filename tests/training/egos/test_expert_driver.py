"""The expert keeps lane and distance, also on curves."""

import numpy as np
import torch

from agents.vision import to_actions
from rare_envs.control.actions import to_physical
from training.egos.curriculum import make_situations, start_situation
from training.egos.expert_driver import EXPERT_BRAKES, auxiliary_targets, expert_outputs


def test_the_expert_keeps_lane_and_distance_from_wherever_situations_begin() -> None:
    for number, situation in enumerate(make_situations()[:3]):
        world, episode = start_situation(situation, 16, 15.0, np.random.default_rng(number))
        with torch.inference_mode():
            for _ in range(world.clock.ticks):
                speed = episode.state.speed[:, 0]
                action = to_physical(to_actions(expert_outputs(episode), speed), 16, episode.collided)
                episode = world.step(episode, action)
            y = episode.state.y[:, 0]
            offset = (y - world.scenario.road.centre_of(y)).abs()
        assert int(episode.collided.sum()) <= 1  # some situations begin too fast and too close
        assert float(offset[~episode.collided].max()) < 0.1


def test_on_a_curve_the_expert_does_not_run_wide() -> None:
    """Held to the curve of its lane, its yaw rate is speed times curvature: no offset remains."""
    rng = np.random.default_rng(0)
    situation = make_situations()[1]
    world, episode = start_situation(situation, 4, 8.0, rng)
    while world.scenario.road.reference_line is None:
        world, episode = start_situation(situation, 4, 8.0, rng)
    with torch.inference_mode():
        for _ in range(world.clock.ticks):
            speed = episode.state.speed[:, 0]
            episode = world.step(episode, to_physical(to_actions(expert_outputs(episode), speed), 4, episode.collided))
        seen = auxiliary_targets(episode)[~episode.collided]
    assert float(seen[:, 2].abs().max()) > 0.05
    assert float(0.5 * seen[:, 0].abs().max()) < 0.05


def test_labels_that_ask_for_more_than_the_brakes_differ_only_where_they_are_the_limit() -> None:
    _, episode = start_situation(make_situations()[1], 256, 1.0, np.random.default_rng(1))
    usual, more = expert_outputs(episode), expert_outputs(episode, brakes=10.0)
    at_limit = usual[:, 0] == -EXPERT_BRAKES / 2.0
    assert 0 < int(at_limit.sum()) < 256
    assert torch.equal(more[~at_limit], usual[~at_limit])
    assert bool((more[at_limit, 0] <= usual[at_limit, 0]).all()) and float(more[:, 0].min()) == -5.0
    speed = episode.state.speed[:, 0]
    assert torch.equal(to_actions(more, speed), to_actions(usual, speed))  # the same is done
