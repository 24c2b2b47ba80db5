"""How the ego that sees is taught: the expert drives, the lessons are as described, a stopped training goes on."""

from pathlib import Path

import numpy as np
import pytest
import torch

from agents import load_ego
from agents.vision.ego import to_actions
from rare_envs.control.actions import to_physical
from training.egos.curriculum import draw_road, make_lessons, start_lesson
from training.egos.expert_driver import auxiliary_targets, expert_outputs
from training.egos.image_dataset import collect, concatenate, mirror
from training.egos.nominal_driving import judge, summarise_verdicts
from training.egos.vision import Training, VisionConfig, train_vision_ego

TINY = VisionConfig(
    rounds=1,
    first_drives=2,
    drives=1,
    rows=3,
    first_ticks=4,
    ticks=4,
    first_kept=1.0,
    kept=1.0,
    first_visits=16,
    visits=16,
    batch=8,
)


def test_the_expert_keeps_lane_and_distance_from_wherever_lessons_begin() -> None:
    for number, lesson in enumerate(make_lessons()[:3]):
        world, episode = start_lesson(lesson, 16, 15.0, np.random.default_rng(number))
        with torch.inference_mode():
            for _ in range(world.clock.ticks):
                speed = episode.state.speed[:, 0]
                action = to_physical(to_actions(expert_outputs(episode), speed), 16, episode.collided)
                episode = world.step(episode, action)
            y = episode.state.y[:, 0]
            offset = (y - world.scenario.road.centre_of(y)).abs()
        assert int(episode.collided.sum()) <= 1  # some lessons begin too fast and too close
        assert float(offset[~episode.collided].max()) < 0.1


def test_on_a_curve_the_expert_does_not_run_wide() -> None:
    """Held to the curve of its lane, its yaw rate is speed times curvature: no offset remains."""
    rng = np.random.default_rng(0)
    lesson = make_lessons()[1]
    world, episode = start_lesson(lesson, 4, 8.0, rng)
    while world.scenario.road.reference_line is None:
        world, episode = start_lesson(lesson, 4, 8.0, rng)
    with torch.inference_mode():
        for _ in range(world.clock.ticks):
            speed = episode.state.speed[:, 0]
            episode = world.step(episode, to_physical(to_actions(expert_outputs(episode), speed), 4, episode.collided))
        seen = auxiliary_targets(episode)[~episode.collided]
    assert float(seen[:, 2].abs().max()) > 0.05
    assert float(0.5 * seen[:, 0].abs().max()) < 0.05


def test_roads_have_lanes_of_which_one_is_the_egos() -> None:
    rng = np.random.default_rng(1)
    roads = [draw_road(rng) for _ in range(60)]
    assert {road.lanes for road in roads} == {1, 2, 3, 4}
    assert 10 < sum(road.reference_line is None for road in roads) < 35
    for road in roads:
        assert float(road.centre_of(torch.zeros(1))[0]) == pytest.approx(0.0, abs=1e-5)


def test_pictures_are_noted_with_what_the_expert_would_do() -> None:
    rng = np.random.default_rng(2)
    parts = list(collect(None, 0.0, drives=2, rows=3, ticks=3, kept=1.0, noise=1.0, rng=rng))
    noted = concatenate(parts)
    assert noted.picture.shape == (18, 66, 200, 3)
    assert torch.equal(noted.earlier[:3], _luma(noted.picture[:3]))  # at time 0 there is no earlier one
    assert noted.wanted.shape == (18, 2) and noted.truth.shape == (18, 5)


def test_pictures_for_the_expert_and_for_a_network_are_the_same() -> None:
    """Where nobody trusts the network, the expert alone drives, by pictures that are all taken."""
    settings = {"drives": 1, "rows": 2, "ticks": 8, "kept": 1.0, "noise": 0.0}
    network = Training(TINY, Path()).network.eval()
    alone = concatenate(list(collect(None, 0.0, rng=np.random.default_rng(3), **settings)))
    mixed = concatenate(list(collect(network, 0.0, rng=np.random.default_rng(3), **settings)))
    assert torch.equal(alone.picture[:4], mixed.picture[:4])
    assert torch.equal(alone.earlier, mixed.earlier)
    torch.testing.assert_close(alone.wanted, mixed.wanted)


def test_mirrored_pictures_ask_for_mirrored_turns() -> None:
    rng = np.random.default_rng(4)
    some = concatenate(list(collect(None, 0.0, drives=1, rows=4, ticks=1, kept=1.0, noise=0.0, rng=rng)))
    turned = mirror(some, torch.tensor([True, False, True, False]))
    assert torch.equal(turned.picture[0], some.picture[0].flip(1)) and torch.equal(turned.picture[1], some.picture[1])
    assert torch.equal(turned.wanted[0], some.wanted[0] * torch.tensor([1.0, -1.0]))
    assert torch.equal(turned.truth[2], some.truth[2] * torch.tensor([-1.0, -1.0, -1.0, 1.0, 1.0]))
    assert all(torch.equal(a[1::2], b[1::2]) for a, b in zip(turned, some, strict=True))


def test_a_stopped_training_goes_on_to_the_same_weights(tmp_path: Path) -> None:
    whole = train_vision_ego(TINY, tmp_path / "whole")
    (tmp_path / "stopped").mkdir()
    stopped = Training(TINY, tmp_path / "stopped")
    for _ in stopped.do_round():
        pass
    for _ in stopped.do_round():
        break  # killed while it collects
    resumed = train_vision_ego(TINY, tmp_path / "stopped")
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name
    assert not torch.equal(whole.head.weight, Training(TINY, tmp_path).network.head.weight)


def test_another_training_in_the_folder_is_refused(tmp_path: Path) -> None:
    train_vision_ego(VisionConfig(**{**vars(TINY), "rounds": 0}), tmp_path)
    with pytest.raises(ValueError, match="other settings"):
        train_vision_ego(TINY, tmp_path)


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="batch"):
        VisionConfig(batch=0)
    with pytest.raises(ValueError, match="mixing of at most 1"):
        VisionConfig(mixing=1.5)


@pytest.mark.parametrize("case", ["straight", "bends"])
def test_the_shipped_ego_keeps_lane_and_distance(case: str) -> None:
    found = summarise_verdicts(judge(load_ego("vision"), case, rollouts=6, seed=11, seconds=6.0))
    assert found.kept == found.judged == 6
    assert found.margin > 0.4


@pytest.mark.slow
@pytest.mark.parametrize("case", ["straight", "i80", "bends"])
def test_the_shipped_ego_keeps_lane_and_distance_for_a_minute(case: str) -> None:
    found = summarise_verdicts(judge(load_ego("vision"), case, rollouts=64, seed=12))
    assert found.kept >= found.judged - 2


def _luma(picture: torch.Tensor) -> torch.Tensor:
    return (picture.double() @ torch.tensor([77, 150, 29]).double() / 256 + 0.5).floor().to(torch.uint8)
