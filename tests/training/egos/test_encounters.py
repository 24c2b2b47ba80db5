"""Encounters are scenarios with a free ego."""

import numpy as np
import torch

import rare_envs
from rare_envs.control.idm import IDM
from rare_envs.scenarios.cut_in import CUT_IN
from rare_envs.simulation.clock import Clock
from rare_envs.simulation.rollout import drive
from rare_envs.simulation.world import World
from training.egos.encounters import APART, EncounterSpec, make_scenes
from training.imitation.traffic import stack_scenes, start_replay, step_replay


def test_an_encounter_is_the_scenario_with_its_ego_free() -> None:
    """Others move as in the scenario whatever the ego does; only egos are driven; every other scene is mirrored."""
    plain, mirrored = make_scenes(
        [EncounterSpec("rare_envs/CutIn-v0", "us101", scenes=2, seconds=4.0)], np.random.default_rng(3)
    )
    world = World(CUT_IN, clock=Clock(horizon=4.0))
    x = rare_envs.DrivingProblem("rare_envs/CutIn-v0").base.sample(26, np.random.default_rng(3))
    with torch.inference_mode():
        states = [episode.state for episode in drive(world, IDM(), torch.from_numpy(x[:13]))]
    expected = torch.stack([state.x[:, 1] for state in states]).numpy() + APART * np.arange(13)
    np.testing.assert_allclose(plain.x[:, 1::3], expected)
    assert plain.edges == (-2.0, 2.0, 6.0)
    assert mirrored.edges == (-6.0, -2.0, 2.0)
    assert (mirrored.y[:, 1::3] <= 0.0).all()

    recording = stack_scenes([plain])
    traffic = start_replay(recording, torch.tensor([0]), torch.tensor([0]))
    assert traffic.driven.sum() == 13
    braking = torch.zeros(1, 39, 2)
    braking[..., 0] = -2.0
    for _ in range(30):
        traffic = step_replay(recording, traffic, braking)
    at = traffic.vehicle[0].argsort()
    others = np.arange(39) % 3 != 0
    np.testing.assert_allclose(traffic.x[0, at].numpy()[others], plain.x[30][others], atol=0.01)
    assert (traffic.x[0, at].numpy()[~others] < plain.x[30][~others]).any()


def test_parameters_may_be_given() -> None:
    (one,) = make_scenes([EncounterSpec("straight", None, 1, 1.0, {"gap": 140.0})], np.random.default_rng(0))
    np.testing.assert_allclose(one.x[0, 1::5] - one.x[0, ::5], 145.0, atol=1e-3)
