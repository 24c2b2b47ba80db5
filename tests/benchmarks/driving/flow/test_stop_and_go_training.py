"""The command of further training in stop-and-go traffic: its two tables, and the file that it writes."""

import pytest
import torch
import typer
from typer.testing import CliRunner

from agents import load_driver, read_driver, read_provenance
from benchmarks.driving.flow import stop_and_go_training as module
from tests.training.imitation.synthetic_scenes import scenes, tiny
from training.imitation.fine_tuning import NARROW_NOISE
from training.imitation.noise_damping import damp_acceleration


@pytest.fixture
def command(monkeypatch):
    monkeypatch.setattr(module, "load_scenes", lambda source: (scenes(2), scenes(3)[2:]))
    monkeypatch.setattr(module, "FINE_TUNING", tiny(updates=1, epochs=0, warm_up=1, colour=NARROW_NOISE))
    monkeypatch.setattr(module, "DENSE_SCENES", 2)
    monkeypatch.setattr(module, "DENSITIES", (45.0,))
    monkeypatch.setattr(module, "SECONDS", 10.0)
    monkeypatch.setattr("benchmarks.driving.flow.long_drives.SETTLING", 5.0)
    monkeypatch.setattr("training.imitation.noise_damping.HORIZONS", (0.5, 1.0))
    app = typer.Typer()
    app.command()(module.main)
    return lambda *words: CliRunner().invoke(app, ["tables", *words])


def test_the_command_measures_before_and_after_and_writes_the_driver(command, tmp_path):
    out = tmp_path / "new.safetensors"
    result = command("--out", str(out), "--updates", "1", "--share", "0.5", "--damping", "0.4", "--seed", "3", "--test")
    assert result.exit_code == 0, result.output
    rows = [line.split(" | ") for line in result.output.splitlines()]
    assert [row[0] for row in rows if row[0] in ("| before", "| after")] == ["| before", "| after"] * 2
    made, before = read_driver(out), load_driver("mgail")
    assert made.name == "new"
    assert made.colour == damp_acceleration(before.colour, 0.4)
    assert not torch.equal(made.policy.head.weight, before.policy.head.weight)
    words = "--driver mgail --rule-weight 0.2 --updates 1 --share 0.5 --seed 3 --damping 0.4"
    assert read_provenance(out).command.endswith(words)


def test_a_rule_is_refused(command, tmp_path):
    result = command("--out", str(tmp_path / "x.safetensors"), "--driver", "idm")
    assert result.exit_code == 2
    assert not (tmp_path / "x.safetensors").exists()
