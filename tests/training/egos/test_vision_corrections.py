"""Corrections of the ego `vision`: what is counted and held out, and that the network learns what it is shown."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import typer

import training.egos.vision_corrections as corrections
from agents.vision import PilotNet, load_vision, luma
from training.egos.image_dataset import LabelledPictures
from training.egos.vision_corrections import (
    VisionCorrectionConfig,
    correct_vision,
    count_failing,
    drive_scenarios,
    learn_pictures,
)

HARD_BRAKE = "rare_envs/HardBrake-v0"
SMALL = VisionCorrectionConfig(
    rounds=1, draws=1, drives=1, watched=1, rows=2, seconds=0.5, visits=8, batch=4, driven=1, simulations=60
)
FAILURES = np.array([[15.0, 2.0, 9.0], [14.0, 2.0, 9.0], [13.0, 2.0, 9.0], [12.0, 2.0, 9.0]])
"""Speed, gap and deceleration: nobody can stop in time."""


@pytest.fixture
def network() -> PilotNet:
    return load_vision().network


def make_pictures(n: int) -> LabelledPictures:
    picture = torch.randint(0, 256, (n, 66, 200, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    return LabelledPictures(picture, luma(picture), torch.full((n,), 10.0), torch.zeros(n, 2), torch.zeros(n, 5))


@pytest.mark.parametrize(
    "wrong", [{"rate": 0.0}, {"rate": float("nan")}, {"seconds": 0.0}, {"seconds": float("inf")}, {"batch": 0}]
)
def test_settings_without_a_meaning_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"Expected .*{next(iter(wrong))}"):
        VisionCorrectionConfig(**wrong)  # type: ignore[arg-type]


def test_the_network_learns_its_labels(network: PilotNet) -> None:
    data = make_pictures(4)
    given = network(data.picture, data.earlier, data.speed)
    data = data._replace(expert=torch.stack((given[:, 0] - 1.0, 0.0 * given[:, 1]), dim=1))
    config = VisionCorrectionConfig(visits=240, batch=8)
    learn_pictures(network, data, config, np.random.default_rng(0))
    after = network(data.picture, data.earlier, data.speed)
    assert (after[:, 0] - data.expert[:, 0]).abs().mean() < 0.5  # before it is 1
    assert not any(part.requires_grad for part in network.parameters())


def test_pictures_of_a_scenario_are_labelled_with_braking_until_the_collision(network: PilotNet) -> None:
    config = VisionCorrectionConfig(seconds=2.0)
    parts = list(drive_scenarios(network, HARD_BRAKE, FAILURES[:2], 1.0, config, np.random.default_rng(0)))
    numbers = [len(part.speed) for part in parts]
    assert numbers[0] == 2 and len(parts) < config.ticks  # nothing is recorded once both have collided
    assert all(part.picture.shape[1:] == (66, 200, 3) for part in parts)
    assert max(part.expert[:, 0].max().item() for part in parts[1:]) < -1.0  # 2 m/s^2 and more


def test_failures_are_counted_and_half_of_them_held_out(network: PilotNet, monkeypatch: pytest.MonkeyPatch) -> None:
    driven: list[np.ndarray[Any, Any]] = []
    drive = corrections.drive_scenarios

    class Found:
        p, interval = 0.25, (0.2, 0.3)

    def watch(network: PilotNet, env_id: str, x: Any, *more: Any) -> Any:
        driven.append(x)
        return drive(network, env_id, x, *more)

    monkeypatch.setattr(corrections, "search_failures", lambda *given: (Found(), FAILURES))
    monkeypatch.setattr(corrections, "drive_scenarios", watch)
    monkeypatch.setattr(corrections, "DRAWN_BY_VISION", ())
    weights = network.head.weight.clone()
    lines: list[str] = []
    corrected, (only,) = correct_vision(network, SMALL, lines.append)
    assert {name: only[name] for name in ("round", "p", "found", "driven", "held_out")} == {
        "round": 0,
        "p": 0.25,
        "found": 4,
        "driven": 1,
        "held_out": 1,
    }
    assert only["driven_failing"] == only["held_out_failing"] == 1  # not to be avoided
    assert len(driven) == 1 and len(driven[0]) == 1 and driven[0][0].tolist() in FAILURES.tolist()
    assert torch.equal(network.head.weight, weights)  # the ego that is given stays as it is
    assert not torch.equal(corrected.head.weight, weights)
    assert lines[0].startswith(f"round 0: {HARD_BRAKE} p = 0.25, 4 failures") and "pictures, loss" in lines[1]


def test_of_no_scenarios_none_fails(network: PilotNet) -> None:
    assert count_failing(network, HARD_BRAKE, np.empty((0, 3))) == 0
    assert not list(drive_scenarios(network, HARD_BRAKE, np.empty((0, 3)), 1.0, SMALL, np.random.default_rng(0)))


def test_a_file_that_is_none_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit):
        corrections.main(tmp_path / "no.safetensors", tmp_path / "out")
    said = capsys.readouterr().err
    assert said.startswith("vision_corrections: ") and said.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("name", "value"), [("rounds", 0), ("batch", 0), ("seed", -1)])
def test_settings_out_of_range_are_refused(name: str, value: int) -> None:
    with pytest.raises(ValueError, match=rf"Expected {name} of at least \d, got {value}"):
        VisionCorrectionConfig(**{name: value})
