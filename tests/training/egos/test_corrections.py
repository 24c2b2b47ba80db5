"""Corrections of the ego `imitation`: what is counted and held out, and that the network learns its labels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import typer

import agents
import training.egos.corrections as corrections
from agents import load_driver
from agents.learned.driver import LearnedDriver, replace_head
from agents.learned.networks import HEAD_SIZE
from training.egos.correction_labels import Labelled
from training.egos.corrections import CorrectionConfig, correct_ego, failing_share, learn_labels

AGENTS = Path(agents.__file__).parent / "data"
SMALL = CorrectionConfig(rounds=1, draws=4, ordinary=1, simulations=600, steps=20, batch=64, recorded=30)
FAILURES = np.array(
    [[25.0, 5.0, 20.0, 2.0, 40.0, 2.5], [30.0, 3.0, 20.0, 2.0, 40.0, 2.3], [40.0, 2.0, 20.0, 1.0, 40.0, 2.3]]
)


@pytest.fixture
def ego() -> LearnedDriver:
    driver = load_driver("imitation")
    assert isinstance(driver, LearnedDriver)
    return driver


def test_the_network_learns_its_labels(ego: LearnedDriver) -> None:
    generator = torch.Generator().manual_seed(0)
    features = torch.rand(256, 51, generator=generator) * 20.0
    outputs = torch.cat(ego.policy(features), dim=1).detach()
    outputs[:, 0] -= 1.0
    before = (outputs[:, 0] - ego.policy(features)[0][:, 0]).abs().mean().item()
    learn_labels(
        ego.policy, Labelled(features, outputs), CorrectionConfig(steps=150, batch=128), np.random.default_rng(0)
    )
    after = (outputs[:, 0] - ego.policy(features)[0][:, 0]).abs().mean().item()
    assert before == pytest.approx(1.0, abs=1e-4)
    assert after < 0.2
    assert not any(part.requires_grad for part in ego.policy.parameters())


def test_failures_are_counted_and_half_of_them_held_out(ego: LearnedDriver, monkeypatch: pytest.MonkeyPatch) -> None:
    driven: list[np.ndarray[Any, Any]] = []
    record, moments = corrections.record_drive, [0]

    def find(driver: LearnedDriver, env_id: str, base: str, simulations: int, seed: int) -> tuple[Any, Any]:
        class Found:
            p, interval = 0.25, (0.2, 0.3)

        return Found(), FAILURES

    def watch(driver: Any, teacher: Any, world: Any, x: Any, every: int, corrected: bool) -> Labelled:
        driven.append(x)
        labelled = record(driver, teacher, world, x, every, corrected)
        moments[0] += len(labelled.features)
        return labelled

    monkeypatch.setattr(corrections, "find_failures", find)
    monkeypatch.setattr(corrections, "record_drive", watch)
    monkeypatch.setattr(corrections, "SEARCHED", (("rare_envs/CutIn-v0", "us101"),))
    monkeypatch.setattr(corrections, "DRAWN", (("rare_envs/CutIn-v0", "us101"),))
    monkeypatch.setattr(corrections, "CASES", {})
    weights = ego.policy.head.weight.clone()
    lines: list[str] = []
    recorded = torch.rand(50, 51) * 20.0
    corrected, (only,) = correct_ego(ego, SMALL, recorded, lines.append)
    assert {name: only[name] for name in ("round", "p", "found", "driven", "held_out")} == {
        "round": 0,
        "p": 0.25,
        "found": 3,
        "driven": 2,
        "held_out": 1,
    }
    kept = [row for row in FAILURES.tolist() if row not in driven[0].tolist()]
    assert len(driven[0]) == 2 and len(kept) == 1
    assert only["held_out_failing"] == failing_share(corrected, "rare_envs/CutIn-v0", np.array(kept))
    assert torch.equal(ego.policy.head.weight, weights)  # the ego that is given stays as it is
    assert not torch.equal(corrected.policy.head.weight, weights)
    assert len(lines) == 2 and lines[1].startswith(f"round 0: {30 + moments[0]:,} moments")


def test_a_search_finds_failures_of_an_ego(ego: LearnedDriver) -> None:
    coasting = replace(ego, policy=replace_head(ego.policy, torch.zeros(HEAD_SIZE)))
    estimate, x = corrections.find_failures(coasting, "rare_envs/CutIn-v0", "us101", 600, seed=1)
    assert estimate.n_sim <= 600
    assert len(x) and failing_share(coasting, "rare_envs/CutIn-v0", x) == 1.0


def test_a_folder_without_data_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit):
        corrections.main(AGENTS / "imitation.safetensors", tmp_path / "out", tmp_path)
    said = capsys.readouterr().err
    assert said.startswith("corrections: ") and said.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("name", "value"), [("rounds", 0), ("batch", 0), ("seed", -1)])
def test_settings_out_of_range_are_refused(name: str, value: int) -> None:
    with pytest.raises(ValueError, match=rf"Expected {name} of at least \d, got {value}"):
        CorrectionConfig(**{name: value})
