"""The report on realism in miniature."""

import json

import numpy as np
import pytest

from agents import LearnedDriver, Provenance, WeightDistribution, save_driver
from agents.learned.networks import HUMAN_NOISE, head_weights
from benchmarks.driving import realism
from benchmarks.driving.realism import format_table, load_named, measure_all, round_numbers
from tests.training.imitation.synthetic_scenes import scenes
from training.imitation.config import Config
from training.imitation.train import make_learner, prepare_data


@pytest.fixture(scope="module")
def data():
    return prepare_data(scenes(2))


@pytest.fixture(scope="module")
def driver(data):
    policy = make_learner(data, Config(epochs=2)).policy.eval().requires_grad_(False)
    mean = head_weights(policy).double().numpy()
    return LearnedDriver(policy, HUMAN_NOISE, weights=WeightDistribution(mean, 1e6 * np.eye(404)), name="mine")


def test_a_report_has_every_row(data, driver, monkeypatch):
    monkeypatch.setattr(realism, "SECONDS", (2.0, 3.0))
    rows = measure_all(data.recording, data.recording, {"mine": driver}, noises=2, draws=2)
    json.dumps(rows, allow_nan=False)
    names = ["people", "constant velocity", "IDM, lane keeping", "mine", "mine, drawn from its distribution"]
    assert [row["name"] for row in rows] == names
    one = rows[3]["2 s"]
    assert one["vehicles"] == 2 * (6 + 6 + 5) * 2  # scenes, starts at 0, 2 and 4 s, sequences of noise
    assert one["collision"] == pytest.approx(np.mean(one["collisions"]))
    assert one["standard_error"]["mean_speed"] > 0
    table = format_table(rows, "3 s")
    assert all(f"| {name} |" in table for name in names)


def test_drivers_are_named_by_their_files(driver, tmp_path):
    about = Provenance(kind="mgail", command="", data="", data_licence="")
    (tmp_path / "second").mkdir()
    for path in (tmp_path / "mine.safetensors", tmp_path / "second" / "driver.safetensors"):
        save_driver(driver, about, path)
    found = load_named([str(tmp_path / "mine.safetensors"), str(tmp_path / "second" / "driver.safetensors")])
    assert list(found) == ["mine", "second"]


def test_numbers_are_rounded():
    assert round_numbers({"a": [1.23456789, 3], "b": "c"}) == {"a": [1.2346, 3], "b": "c"}
