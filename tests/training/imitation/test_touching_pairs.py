"""Pairs that touch: each once, with its first moment, and not those that touch from the start."""

import torch
import typer
from typer.testing import CliRunner

from tests.training.imitation.synthetic_scenes import scenes
from training.imitation import touching_pairs as module
from training.imitation.evaluation.behaviour import drive_traffic
from training.imitation.touching_pairs import find_touching_pairs
from training.imitation.traffic.recording import stack_scenes
from training.imitation.traffic.replayed_traffic import start_replay


def standing(x, driven):
    """Vehicles of 4.5 m one behind the other, of which the first ones are driven; all stand."""
    recording = stack_scenes(scenes(1))
    traffic = start_replay(recording, torch.zeros(1, dtype=torch.long), torch.zeros(1, dtype=torch.long))
    n = len(x)
    fields = {name: getattr(traffic, name)[:, :n].clone() for name in ("heading", "speed", "length", "width")}
    return traffic._replace(
        x=torch.tensor([x]),
        y=torch.full((1, n), 1.8),
        there=torch.ones(1, n, dtype=torch.bool),
        driven=torch.tensor([driven]),
        vehicle=traffic.vehicle[:, :n],
        **{**fields, "speed": torch.zeros(1, n), "heading": torch.zeros(1, n)},
    )


def forward(first, acceleration=1.0):
    """Let the first vehicle speed up."""

    def act(features, memory):
        action = torch.zeros(*features.shape[:2], 2)
        action[:, first, 0] = acceleration
        return action, None

    return act


def test_a_pair_counts_once_with_its_first_moment():
    pairs = find_touching_pairs(drive_traffic(None, standing([0.0, 5.0], [True, True]), forward(0), 14))
    (pair,) = pairs
    # 0.5 m at 1 m/s^2 by Euler steps of 0.1 s: 0.005 k (k - 1) > 0.5 first at k = 11
    assert pair.first == 11
    assert pair.steps == 2 * 3  # ticks 11, 12 and 13, of two driven vehicles
    assert not pair.replayed
    assert (pair.scene, pair.start) == (0, 0)
    assert 4.4 < pair.along < 4.5
    assert pair.across == 0.0


def test_steps_of_replayed_vehicles_do_not_count():
    (pair,) = find_touching_pairs(drive_traffic(None, standing([0.0, 5.0], [True, False]), forward(0), 14))
    assert pair.replayed
    assert pair.steps == 3


def test_those_that_touch_from_the_start_are_left_out_and_the_longest_comes_first():
    """The first two overlap at once; the third reaches the fourth after the fifth has reached the sixth."""
    traffic = standing([0.0, 4.0, 30.0, 35.0, 60.0, 64.8], [True] * 6)

    def act(features, memory):
        action = torch.zeros(*features.shape[:2], 2)
        action[:, (2, 4), 0] = 1.0
        return action, None

    one, other = find_touching_pairs(drive_traffic(None, traffic, act, 14))
    assert one.first < other.first == 11
    assert one.steps > other.steps


def test_the_command_prints_a_table_and_refuses_a_rule(monkeypatch):
    monkeypatch.setattr(module, "load_scenes", lambda source: (scenes(2), scenes(3)[2:]))
    app = typer.Typer()
    app.command()(module.main)
    result = CliRunner().invoke(app, ["tables", "--seconds", "0.5"])
    assert result.exit_code == 0, result.output
    assert "vehicle-steps" in result.output.splitlines()[0]
    assert CliRunner().invoke(app, ["tables", "--driver", "idm"]).exit_code == 2
