"""Drivers in files: what goes in comes out, nothing is run on reading, and what may be wrong with a file is said."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from safetensors import safe_open

from agents import LearnedDriver, Provenance, load_driver, read_driver, read_provenance, save_driver
from agents.learned.networks import AutoregressiveNoise
from agents.learned.rules import CollisionAvoidance, LaneChanges

PROVENANCE = Provenance(
    kind="mgail",
    command="python -m training.train_driver --seed 1",
    data="a recording",
    data_licence="CC BY-SA 3.0",
    metrics={"collision": 0.004, "js": {"speed": 0.03}},
    ensemble={"penalty": 0.5, "tried": [{"penalty": 0.5, "condition": 3.0}]},
)


@pytest.fixture
def driver(policy, weight_distribution):
    return LearnedDriver(
        policy,
        AutoregressiveNoise((0.95, 0.9), (-0.1, -0.2), balanced=True),
        (-7.0, 3.5),
        (-0.25, 0.3),
        weight_distribution,
        "tester",
        CollisionAvoidance(reaction_time=0.9),
        0.9,
        LaneChanges(duration=4.0),
    )


@pytest.fixture
def file(driver, tmp_path):
    return save_driver(driver, PROVENANCE, tmp_path / "driver.safetensors")


def rewrite(file: Path, header=None, **tensors) -> Path:
    """Change a file: entries of the header, and tensors by name, dots written as double underscores; None removes."""
    with safe_open(file, framework="pt") as old:
        content = json.loads(old.metadata()["driver"]) | (header or {})
    changed = safetensors.torch.load_file(file) | {name.replace("__", "."): value for name, value in tensors.items()}
    kept = {name: value for name, value in changed.items() if value is not None}
    content = {name: value for name, value in content.items() if value is not ...}
    safetensors.torch.save_file(kept, file, {"driver": json.dumps(content)})
    return file


def test_a_driver_comes_back_as_it_was(driver, file, features, generator):
    again = read_driver(file)
    x, xi = features(4, 3), torch.randn(4, 3, 2, generator=generator)
    weights = torch.from_numpy(driver.weights.sample(4, np.random.default_rng(1)))
    memory = driver.begin(torch.randn(4, 3, 2, 2, generator=generator))
    for given in (None, weights):
        made, expected = (one.act(x, given, xi, memory) for one in (again, driver))
        torch.testing.assert_close(made, expected, atol=0.0, rtol=0.0)
    for name in ("colour", "acceleration", "yaw_rate", "name", "avoidance", "hard_braking", "changes"):
        assert getattr(again, name) == getattr(driver, name)
    np.testing.assert_array_equal(again.weights.mean, driver.weights.mean)
    np.testing.assert_array_equal(again.weights.precision, driver.weights.precision)
    assert again.weights.radius == driver.weights.radius
    assert read_provenance(file) == PROVENANCE
    assert not any(p.requires_grad for p in again.policy.parameters())
    assert not again.policy.training


def test_equal_drivers_are_equal_bytes_and_small_and_reading_draws_and_unpickles_nothing(file, tmp_path, monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("unpickled")

    for module, name in ((torch, "load"), (pickle, "load"), (pickle, "loads"), (pickle, "Unpickler")):
        monkeypatch.setattr(module, name, refuse)
    before = torch.get_rng_state()
    again = save_driver(read_driver(file), PROVENANCE, tmp_path / "again.safetensors")
    assert torch.equal(torch.get_rng_state(), before)
    assert again.read_bytes() == file.read_bytes()
    assert file.stat().st_size < 300_000
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["again.safetensors", "driver.safetensors"]


def test_other_files_are_told_apart(driver, tmp_path):
    pickled, text, bare = (tmp_path / f"{name}.safetensors" for name in ("pickled", "text", "bare"))
    torch.save(driver.policy.state_dict(), pickled)
    with pytest.raises(ValueError, match=r"not a safetensors file.*torch\.save"):
        read_driver(pickled)
    text.write_text("hello")
    with pytest.raises(ValueError, match="not a safetensors file") as error:
        read_driver(text)
    assert "torch.save" not in str(error.value)
    safetensors.torch.save_file({"a": torch.zeros(1)}, bare)
    with pytest.raises(ValueError, match="tensors but no driver"):
        read_driver(bare)
    with pytest.raises(FileNotFoundError, match=r"bear\.safetensors.*in that folder: bare\.safetensors"):
        read_driver(bare.with_name("bear.safetensors"))


WRONG = (
    ({"policy__first__weight": None}, r"lacks policy\.first\.weight"),
    ({"weights__rows": None}, r"lacks weights\.rows"),
    ({"policy__head__bias": torch.zeros(6)}, r"policy\.head\.bias of shape \(4,\) .* got \(6,\)"),
    ({"policy__head__bias": torch.zeros(4).double()}, r"float32, got \(4,\) and torch\.float64"),
    ({"policy__head__bias": torch.full((4,), torch.nan)}, r"inf or NaN in policy\.head\.bias"),
    ({"weights__precision": torch.zeros(3).double()}, "no usable driver: .*same length"),
    ({"header": {"colour": {"first": [0.9, 1.5], "second": [0.0, 0.0]}}}, "no usable driver.*stationary"),
    ({"header": {"colour": ...}}, "lacks colour"),
    ({"header": {"colour": 0.9}}, "no usable driver"),
    ({"header": {"format": 2}}, "format 2 where this version reads 1"),
    ({"header": {"feature_clip": 10.0}}, r"feature_clip 10\.0 where"),
    ({"header": {"features": ["lane_offset", "speed"]}}, "features 'speed' where this version reads 'heading'"),
    ({"header": {"features": None}}, "features None where"),
)


def test_what_is_wrong_with_a_file_is_said(driver, tmp_path):
    for changes, message in WRONG:
        file = save_driver(driver, PROVENANCE, tmp_path / "driver.safetensors")
        with pytest.raises(ValueError, match=message):
            read_driver(rewrite(file, **changes))


def test_what_cannot_be_saved_is_refused(driver, tmp_path):
    with pytest.raises(ValueError, match=r"ends with \.safetensors"):
        save_driver(driver, PROVENANCE, tmp_path / "driver.pt")
    bad = Provenance(kind="gail", command="", data="", data_licence="", metrics={"collision": float("nan")})
    with pytest.raises(ValueError, match="JSON"):
        save_driver(driver, bad, tmp_path / "driver.safetensors")
    driver.policy.head.bias[0] = torch.inf
    with pytest.raises(ValueError, match=r"inf or NaN in policy\.head\.bias"):
        save_driver(driver, PROVENANCE, tmp_path / "driver.safetensors")
    assert not list(tmp_path.iterdir())


def test_unknown_names_get_a_suggestion(file, monkeypatch):
    with pytest.raises(
        ValueError, match=r"'mgial' \(did you mean 'mgail'\?\); expected 'mgail', 'gail', 'imitation', 'idm'"
    ):
        load_driver("mgial")
    with pytest.raises(ValueError, match="did you mean 'idm'"):
        load_driver("IDM")
    monkeypatch.chdir(file.parent)
    with pytest.raises(ValueError, match=r"did you mean 'driver\.safetensors'"):
        load_driver("driver")


def test_a_shipped_driver_may_drive_without_its_rules():
    features = torch.rand(3, 2, 51, generator=torch.Generator().manual_seed(0))
    whole, alone = load_driver("mgail"), load_driver("mgail?rules=0")
    assert (alone.avoidance, alone.changes, alone.hard_braking) == (None, None, 1.0)
    scaling, (mean, _) = alone.policy.scaling, alone.policy(features)
    expected = scaling.action_mean + scaling.action_std * mean
    low, high = torch.tensor((alone.acceleration, alone.yaw_rate)).T
    assert torch.equal(alone.act(features)[0], torch.clamp(expected, low, high))
    assert not torch.equal(whole.act(features)[0], alone.act(features)[0])
    with pytest.raises(ValueError, match=r"Expected mgail or mgail\?rules=0, got 'mgail\?rule=0'"):
        load_driver("mgail?rule=0")
