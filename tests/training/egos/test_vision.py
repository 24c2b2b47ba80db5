"""Training of the ego `vision`: the expert drives, a checkpoint resumes, the result is judged."""

from pathlib import Path

import pytest
import torch

from agents import load_ego
from training.egos.nominal_driving import judge, summarise_verdicts
from training.egos.vision import Training, VisionConfig, train_vision_ego

TINY = VisionConfig(
    rounds=1,
    first_drives=2,
    drives=1,
    rows=3,
    first_ticks=4,
    ticks=4,
    first_recorded_share=1.0,
    recorded_share=1.0,
    first_visits=16,
    visits=16,
    batch=8,
)


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
    assert found.passed == found.judged == 6
    assert found.margin > 0.4


@pytest.mark.slow
@pytest.mark.parametrize("case", ["straight", "i80", "bends"])
def test_the_shipped_ego_keeps_lane_and_distance_for_a_minute(case: str) -> None:
    found = summarise_verdicts(judge(load_ego("vision"), case, rollouts=64, seed=12))
    assert found.passed >= found.judged - 2
