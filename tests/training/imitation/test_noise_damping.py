"""Less damped noise of the acceleration: the same variance and jerk, less power at low frequencies."""

import cmath

import pytest
import torch
import typer
from typer.testing import CliRunner

from agents import load_driver, read_driver, read_provenance
from agents.learned.coloured_noise import WHITE_NOISE, AutoregressiveNoise
from tests.training.imitation.synthetic_scenes import scenes
from training.imitation import noise_damping as module
from training.imitation.algorithms.config import HUMAN_NOISE
from training.imitation.noise_damping import damp_acceleration


def power(noise, frequency):
    """Spectral power of the noise of the acceleration at a frequency [rad/s]."""
    step = cmath.exp(-0.1j * frequency)
    return abs(noise.scale[0] / (1.0 - noise.first[0] * step - noise.second[0] * step**2)) ** 2


def neighbours(noise):
    """Correlation of consecutive accelerations, which decides the jerk."""
    return noise.first[0] / (1.0 - noise.second[0])


def test_the_own_damping_changes_nothing():
    same = damp_acceleration(HUMAN_NOISE, 0.845)
    assert same.first == pytest.approx(HUMAN_NOISE.first)
    assert same.second == pytest.approx(HUMAN_NOISE.second)


def test_less_damping_takes_power_from_low_frequencies_and_leaves_the_jerk():
    less = damp_acceleration(HUMAN_NOISE, 0.4)
    assert power(less, 0.0) / power(HUMAN_NOISE, 0.0) == pytest.approx(0.4 / 0.845, rel=0.05)
    assert 1.0 - neighbours(less) == pytest.approx(1.0 - neighbours(HUMAN_NOISE), rel=0.06)
    assert (less.first[1], less.second[1]) == (HUMAN_NOISE.first[1], HUMAN_NOISE.second[1])
    values, memory = [], less.begin(torch.zeros(2, 2))
    generator = torch.Generator().manual_seed(0)
    memory = less.begin(torch.randn(4000, 2, 2, generator=generator))
    for _ in range(30):
        value, memory = less.step(memory, torch.randn(4000, 2, generator=generator))
        values.append(value[:, 0])
    assert float(torch.stack(values).var()) == pytest.approx(1.0, abs=0.05)


def test_noise_that_does_not_oscillate_is_refused():
    for noise in (WHITE_NOISE, AutoregressiveNoise((1.7, 1.7), (-0.71, -0.71))):
        with pytest.raises(ValueError, match="that oscillates"):
            damp_acceleration(noise, 0.4)
    with pytest.raises(ValueError, match=r"below the natural frequency, 1\.9, got 2"):
        damp_acceleration(HUMAN_NOISE, 2.0)


@pytest.fixture
def command(monkeypatch):
    monkeypatch.setattr(module, "load_scenes", lambda source: (scenes(2), scenes(3)[2:]))
    monkeypatch.setattr(module, "HORIZONS", (0.5, 1.0))
    app = typer.Typer()
    app.command()(module.main)
    return lambda *words: CliRunner().invoke(app, ["tables", *words])


def test_the_command_measures_each_damping_and_writes_the_last(command, tmp_path):
    out = tmp_path / "calm.safetensors"
    result = command("--damping", "0.6", "--damping", "0.4", "--test", "--out", str(out))
    assert result.exit_code == 0, result.output
    rows = [line.split(" | ")[0] for line in result.output.splitlines()]
    assert rows[2:5] == ["| as it is", "| 0.6", "| 0.4"]
    made, before = read_driver(out), load_driver("mgail")
    assert made.name == "calm"
    assert made.colour == damp_acceleration(before.colour, 0.4)
    assert torch.equal(made.policy.head.weight, before.policy.head.weight)
    assert read_provenance(out).command.endswith("--driver mgail --damping 0.4 --out OUT")
    assert read_provenance(out).metrics["10 s"]["vehicles"] > 0


def test_a_rule_has_no_noise(command):
    result = command("--driver", "idm")
    assert result.exit_code == 2
    assert "Expected a learned driver" in result.output + (result.stderr if result.stderr_bytes else "")
