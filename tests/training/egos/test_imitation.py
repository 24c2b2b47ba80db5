"""The shipped ego `imitation`: what it learns in, that its training repeats, and that it drives as it should."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import agents
import rare_envs
from rare_envs.simulation.observation import observation_space
from tests.training.imitation.synthetic_scenes import scene
from tests.training.shared_data import DATA, needs_data
from training.data.table import SCENES_FILE
from training.egos.corrections import CorrectionConfig
from training.egos.encounters import EncounterSpec
from training.egos.imitation import CONFIG, prepare_learner, train_imitation_ego
from training.egos.nominal_driving import judge, summarise_verdicts
from training.egos.nominal_traffic import CASES
from training.imitation.config import Config
from training.imitation.train import train_learner


@pytest.fixture(scope="module")
def tiny() -> tuple[Config, list[EncounterSpec]]:
    config = Config(
        updates=2, pools=1, scenes=3, horizon=(4, 4), epochs=1, warm_up=1, headway_weight=8.0, lane_weight=8.0
    )
    return config, [
        EncounterSpec("rare_envs/CutIn-v0", "us101", seconds=2.0),
        EncounterSpec("hard_brake", None, seconds=2.0),
    ]


def test_training_repeats_and_learns_from_people_only(tiny: tuple[Config, list[EncounterSpec]]) -> None:
    config, kinds = tiny
    scenes = [scene(vehicles=8, ticks=30, name=name) for name in "ab"]
    learners = [prepare_learner(scenes, kinds, config) for _ in range(2)]
    assert learners[0].pairs.scene.max() < len(scenes)
    assert set(learners[0].among.tolist()) == {0, 1, 2, 3}
    one, other = (train_learner(learner).state_dict() for learner in learners)
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_it_is_found_by_name_and_tells_where_it_comes_from() -> None:
    ego = agents.load_ego("imitation")
    assert isinstance(ego, agents.LearnedEgo)
    assert ego.driver.name == "imitation"
    told = agents.read_provenance(Path(agents.__file__).parent / "data" / "imitation.safetensors")
    assert told.command == (
        f"python -m training.egos.imitation --data data --seed {CONFIG.seed}, then python -m training.egos.corrections "
        f"DRIVER --data data --out OUT --seed {CorrectionConfig.seed} --rounds {CorrectionConfig.rounds}"
    )
    assert set(told.metrics["ordinary"]) == set(CASES)


def test_it_is_no_driver_of_the_traffic() -> None:
    with pytest.raises(ValueError, match=r"expected one of 'gail', 'idm', 'idm\+mobil', 'mgail'"):
        rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", drivers="imitation")


def test_it_needs_no_observation_in_a_process_of_its_own_either() -> None:
    """Elsewhere it is an ego with `predict`, whose space tells that it wants the lidar."""
    away = SimpleNamespace(
        predict=agents.load_ego("imitation").predict, observation_space=observation_space(1, "lidar")
    )
    problem = rare_envs.DrivingProblem("rare_envs/CutIn-v0", ego=away)
    here = rare_envs.DrivingProblem("rare_envs/CutIn-v0", ego=agents.load_ego("imitation"))
    x = here.base.sample(32, np.random.default_rng(0))
    gentle = here.evaluate(x) > 2.0  # where no more than the environment's 5 m/s^2 is needed
    np.testing.assert_allclose(problem.evaluate(x)[gentle], here.evaluate(x)[gentle], atol=0.05)


@pytest.mark.parametrize("case", ["straight", "bends"])
def test_it_keeps_its_lane_and_its_distance_for_a_minute(case: str) -> None:
    found = summarise_verdicts(judge(agents.load_ego("imitation"), case, rollouts=32, seed=2026))
    assert found.passed >= found.judged - 1
    assert found.margin > 0.3


def test_it_brakes_for_those_who_cut_in() -> None:
    """The driver of the traffic, which never met encounters, collides in one of seven."""
    collided = {}
    for name in ("imitation", "mgail?rules=0"):
        problem = rare_envs.DrivingProblem("rare_envs/CutIn-v0", ego=agents.load_ego(name))
        collided[name] = (problem.evaluate(problem.base.sample(512, np.random.default_rng(2026))) < 0.0).mean()
    assert collided["imitation"] == 0.0 < 0.1 < collided["mgail?rules=0"]


@pytest.mark.slow
@needs_data(SCENES_FILE)
def test_a_training_from_the_tables_gives_an_ego_and_refuses_another_s_folder(
    tiny: tuple[Config, list[EncounterSpec]], tmp_path: Path
) -> None:
    config, kinds = tiny
    path = train_imitation_ego(DATA, config, tmp_path, kinds=kinds, rollouts=2)
    ego = agents.load_ego(path)
    assert isinstance(ego, agents.LearnedEgo)
    assert agents.read_provenance(path).metrics["ordinary"]["straight"]["judged"] == 2
    with pytest.raises(ValueError, match="another folder"):
        train_imitation_ego(DATA, replace(config, seed=1), tmp_path, kinds=kinds)
