"""Recipes of the egos: the judge of ordinary traffic, encounters, pictures with labels, and that the trainings run."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch

import agents
import rare_envs
from agents.vision import to_actions
from rare_envs.control.actions import to_physical
from rare_envs.control.idm import IDM
from tests.training.imitation.synthetic_scenes import scene
from training.imitation.config import Config
from training.imitation.traffic import stack_scenes, start_replay, step_replay
from training.imitation.train import train_learner
from training.recipes import imitation, vision
from training.recipes.imitation import EncounterSpec, make_scenes
from training.recipes.ordinary_traffic import FLOOR_HEADWAY, VERDICT_NAMES, judge
from training.recipes.situations import make_situations, start_situation


@dataclass(frozen=True)
class Flawed:
    """IDM with lane keeping, and something wrong with its actions."""

    steering: float | None = None
    brakes: bool = True
    acceleration: float | None = None

    def act(self, episode: Any, memory: Any) -> tuple[torch.Tensor, Any]:
        action, memory = IDM().act(episode, memory)
        acceleration, steering = action.unbind(1)
        if self.acceleration is not None:
            acceleration = torch.full_like(acceleration, self.acceleration)
        if self.steering is not None:
            steering = torch.full_like(steering, self.steering)
        if not self.brakes:
            acceleration = acceleration.clamp(min=0.0)
        return torch.stack((acceleration, steering), 1), memory


def reasons(found: Any) -> Counter[str]:
    return Counter(VERDICT_NAMES[k] for k in found.reason.tolist())


@pytest.mark.parametrize("case", [*(pytest.param(c, marks=pytest.mark.slow) for c in ("straight", "i80")), "bends"])
def test_a_driver_by_rule_is_nominal(case: str) -> None:
    found = judge(agents.load_ego("idm"), case, rollouts=6, seed=3, seconds=20.0)
    assert reasons(found) == {"passed": 6}
    assert found.headway.min() > FLOOR_HEADWAY and found.margin.min() > 0.4


@pytest.mark.parametrize("reason", ["left its lane", "too close", "left behind"])
def test_a_flawed_driver_is_caught_and_the_reason_is_told(reason: str) -> None:
    flaws: dict[str, Any] = {"left its lane": {"steering": 0.005}, "too close": {"brakes": False}}
    ego = Flawed(**flaws.get(reason, {"acceleration": -1.0}))
    found = reasons(judge(ego, "straight", rollouts=16, seed=1, seconds=30.0))
    assert found.keys() <= {reason, "passed"} and found["passed"] < 8  # some leads only ever drive away


def test_an_encounter_is_the_scenario_with_its_ego_free() -> None:
    """Others move as recorded whatever the ego does; only egos are driven; every other scene is mirrored."""
    plain, mirrored = make_scenes([EncounterSpec("rare_envs/CutIn-v0", "us101", 2, 4.0)], np.random.default_rng(3))
    assert plain.edges == (-2.0, 2.0, 6.0) and mirrored.edges == (-6.0, -2.0, 2.0)
    assert (mirrored.y[:, 1::3] <= 0.0).all()
    recording = stack_scenes([plain])
    traffic = start_replay(recording, torch.tensor([0]), torch.tensor([0]))
    assert traffic.driven.sum() == 13
    braking = torch.zeros(1, 39, 2)
    braking[..., 0] = -2.0
    for _ in range(30):
        traffic = step_replay(recording, traffic, braking)
    x, others = traffic.x[0, traffic.vehicle[0].argsort()].numpy(), np.arange(39) % 3 != 0
    np.testing.assert_allclose(x[others], plain.x[30][others], atol=0.01)
    assert (x[~others] < plain.x[30][~others]).any()


@pytest.mark.slow
def test_the_training_among_encounters_repeats_and_learns_from_people_only() -> None:
    config = Config(
        updates=1, pools=1, scenes=3, horizon=(4, 4), epochs=1, warm_up=1, headway_weight=8.0, lane_weight=8.0
    )
    kinds = [EncounterSpec("rare_envs/CutIn-v0", "us101", 1, 2.0), EncounterSpec("hard_brake", None, 1, 2.0)]
    scenes = [scene(vehicles=8, ticks=30, name=name) for name in "ab"]
    learners = [imitation.prepare_learner(scenes, kinds, config) for _ in range(2)]
    assert learners[0].pairs.scene.max() < len(scenes)
    assert set(learners[0].among.tolist()) == {0, 1, 2, 3}
    one, other = (train_learner(learner).state_dict() for learner in learners)
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_it_brakes_for_those_who_cut_in() -> None:
    """The driver of the traffic, which never met encounters, collides in one of seven."""
    collided = {}
    for name in ("imitation", "mgail?rules=0"):
        problem = rare_envs.DrivingProblem("rare_envs/CutIn-v0", ego=agents.load_ego(name))
        collided[name] = (problem.evaluate(problem.base.sample(256, np.random.default_rng(2026))) < 0.0).mean()
    assert collided["imitation"] == 0.0 < 0.1 < collided["mgail?rules=0"]


@pytest.mark.parametrize(
    ("name", "case", "seconds"),
    [
        ("imitation", "straight", 20.0),
        ("vision", "bends", 4.0),
        pytest.param("vision", "i80", 60.0, marks=pytest.mark.slow),
    ],
)
def test_shipped_egos_keep_lane_and_distance(name: str, case: str, seconds: float) -> None:
    rollouts = 4 if seconds < 10.0 else 16
    found = judge(agents.load_ego(name), case, rollouts=rollouts, seed=2026, seconds=seconds)
    assert reasons(found)["passed"] >= rollouts - (rollouts > 4)
    assert found.margin.min() > 0.3


def test_the_expert_of_vision_keeps_lane_and_distance_from_wherever_situations_begin() -> None:
    """It does not run wide on curves either: its yaw rate is speed times curvature."""
    for number, situation in enumerate(make_situations()[:3]):
        world, episode = start_situation(situation, 8, 12.0, np.random.default_rng(number))
        with torch.inference_mode():
            for _ in range(world.clock.ticks):
                output, speed = vision.expert_outputs(episode), episode.state.speed[:, 0]
                episode = world.step(episode, to_physical(to_actions(output, speed), 8, episode.collided))
            offset = 0.5 * vision.auxiliary_targets(episode)[:, 0].abs()
        assert int(episode.collided.sum()) <= 1  # some situations begin too fast and too close
        assert float(offset[~episode.collided].max()) < 0.1


def test_pictures_carry_the_outputs_of_the_expert_mirrored_with_the_picture() -> None:
    rng = np.random.default_rng(4)
    some = vision.concatenate(list(vision.drive_situations(None, 0.0, 1, 4, 2, rng, recorded_share=1.0, noise=1.0)))
    assert some.picture.shape == (8, 66, 200, 3) and some.expert.shape == (8, 2) and some.truth.shape == (8, 5)
    turned = vision.mirror(some, torch.tensor([True, False] * 4))
    assert torch.equal(turned.picture[0], some.picture[0].flip(1))
    assert torch.equal(turned.expert[0], some.expert[0] * torch.tensor([1.0, -1.0]))
    assert torch.equal(turned.truth[2], some.truth[2] * torch.tensor([-1.0, -1.0, -1.0, 1.0, 1.0]))
    assert all(torch.equal(a[1::2], b[1::2]) for a, b in zip(turned, some, strict=True))


@pytest.mark.slow
def test_a_tiny_training_of_vision_runs_and_repeats() -> None:
    plan = vision.VisionPlan(
        rounds=1, drives=(7, 4), rows=2, ticks=(6, 6), recorded=(0.5, 0.5), visits=(40, 30), batch=8
    )
    network, other = vision.train_vision(plan), vision.train_vision(plan)
    assert all(torch.equal(a, b) for a, b in zip(network.parameters(), other.parameters(), strict=True))
