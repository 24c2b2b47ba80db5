"""The report on realism in miniature."""

import json

import numpy as np
import pytest
import torch

from agents import LearnedDriver, WeightDistribution
from agents.learned.networks import head_weights
from benchmarks.driving import realism_rows as imitation_rows
from benchmarks.driving.forward_model import compare_gradients
from benchmarks.driving.realism import load_named, measure_all, round_numbers
from benchmarks.driving.realism_figures import format_tables, write_figures
from benchmarks.driving.realism_rows import Effort, highway_starts, move_weights
from tests.training.imitation.synthetic_scenes import scenes
from training.imitation.algorithms.config import HUMAN_NOISE, Config
from training.imitation.fit import make_learner, prepare_data


@pytest.fixture(scope="module")
def data():
    return prepare_data(scenes(2))


@pytest.fixture(scope="module")
def driver(data):
    policy = make_learner(data, Config(epochs=2)).policy.eval().requires_grad_(False)
    mean = head_weights(policy).double().numpy()
    return LearnedDriver(policy, HUMAN_NOISE, weights=WeightDistribution(mean, 1e6 * np.eye(404)), name="bc")


def test_a_report_has_every_row_table_and_figure(data, driver, tmp_path, monkeypatch):
    monkeypatch.setattr(imitation_rows, "RADII", (0.1,))
    monkeypatch.setattr(imitation_rows, "SECONDS", (2.0, 3.0))
    effort = Effort(noises=2, draws=2, rollouts=2, each=1, highway=5)
    found = measure_all(data.recording, data.recording, {"bc": driver}, effort)
    json.dumps(found, allow_nan=False)
    names = [row["name"] for row in found["realism"] if row["kind"] != "box"]
    assert names == ["people", "constant velocity", "IDM, lane keeping", "bc", "bc, drawn from its distribution"]
    one = next(row for row in found["realism"] if row["name"] == "bc")["2 s"]
    assert one["vehicles"] == 2 * (6 + 6 + 5) * 2  # scenes, starts at 0, 2 and 4 s, sequences of noise
    assert one["collision"] == pytest.approx(np.mean(one["collisions"]))
    assert one["standard_error"]["mean_speed"] > 0
    boxes = [row for row in found["realism"] if row["kind"] == "box"]
    assert len(boxes) == 10
    speeds = {row["direction"]: row["2 s"]["mean_speed"] for row in boxes}
    assert speeds["acceleration -"] < one["mean_speed"] < speeds["acceleration +"]
    text = format_tables(found)
    for name in [*names, "yaw rate +", "One vehicle driven"]:
        assert name in text
    write_figures(found, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"rates.svg", "distributions.svg", "errors.svg", "boxes.svg"}


def test_moves_stay_in_their_box_and_aligned_ones_move_one_output_the_furthest(driver):
    features = torch.randn(20, 51, generator=torch.Generator().manual_seed(0))
    mean = torch.from_numpy(np.array(driver.weights.mean)).float()
    hidden = torch.cat((driver.policy.trunk(features).mean(dim=0), torch.ones(1)))
    for radius, direction, weights in move_weights(driver, features, 2):
        for row in weights:
            assert (row - mean).abs().max() <= radius * (1 + 1e-4)
        if direction == "yaw rate -":
            shift = (weights[0] - mean).view(4, 101) @ hidden
            assert shift[1] == pytest.approx(-radius * float(hidden.abs().sum()), rel=1e-3)
            assert shift[[0, 2, 3]].abs().max() == 0


def test_six_cars_start_within_40_m_one_in_each_lane():
    start = highway_starts(50)
    assert start.x.min() > 0
    assert start.x.max() < 40
    assert ((start.y > start.edges[:, :-1]) & (start.y < start.edges[:, 1:])).all()
    assert start.speed.min() > 10
    assert start.speed.max() < 20
    assert start.drivers == 6


def test_drivers_are_named_by_their_files(driver, tmp_path):
    from agents import Provenance, save_driver

    about = Provenance(kind="bc", command="", data="", data_licence="")
    (tmp_path / "second").mkdir()
    for path in (tmp_path / "mine.safetensors", tmp_path / "second" / "driver.safetensors"):
        save_driver(driver, about, path)
    found = load_named([str(tmp_path / "mine.safetensors"), str(tmp_path / "second" / "driver.safetensors")])
    assert list(found) == ["mine", "second"]


def test_numbers_are_rounded():
    assert round_numbers({"a": [1.23456789, 3], "b": "c"}) == {"a": [1.2346, 3], "b": "c"}


def test_gradients_of_both_ways_are_compared(data):
    learner = make_learner(data, Config(learned_model=True, epochs=1, scenes=2))
    learned, noise, blind, length = compare_gradients(learner, 3, starts=2)
    assert max(abs(learned), abs(noise), abs(blind)) <= 1 + 1e-5
    assert noise > 0
    assert length > 0
