"""Ordinary traffic: starts that are safe, speeds that vary as recorded ones do."""

import numpy as np
import torch

from rare_envs.control.idm import IDM
from rare_envs.simulation.rollout import drive
from rare_envs.traffic.neighbours import lead_of
from training.egos.nominal_driving import make_world
from training.egos.nominal_traffic import CASES, draw_starts


def test_starts_are_ordinary() -> None:
    """Nobody is too close, in the lane only, and a driver who keeps its speed for 2 s has not hit anybody."""
    x = draw_starts(500, np.random.default_rng(0))
    speed, lead_speed, gap = x[:, :3].T
    assert (gap >= 0.8 * speed).all()
    assert (gap - 2.0 * np.maximum(speed - lead_speed, 0.0) > 0.0).all()
    for case in CASES.values():
        for parameter, column in zip(case.scenario.parameters, x.T, strict=False):
            if case.scenario.size == x.shape[1]:
                assert parameter.low <= column.min() <= column.max() <= parameter.high, parameter.name


def test_speeds_of_leads_wander_as_recorded_ones_do() -> None:
    """Spread over a minute: 2.0 to 4.8 m/s between the deciles of what US 101 has over 640 m."""
    world = make_world(CASES["straight"])
    rng = np.random.default_rng(2)
    x = np.concatenate((draw_starts(64, rng), rng.standard_normal((64, world.columns.noise))), axis=1)
    with torch.inference_mode():
        moments = list(drive(world, IDM(), torch.from_numpy(x).float()))
        speeds = torch.stack([moment.state.speed[:, 1] for moment in moments])
        gaps = torch.stack([lead_of(moment.state, moment.road).gap for moment in moments])
    assert 1.5 < float(speeds.std(0).median()) < 4.0
    assert 0.5 < float((speeds.diff(dim=0) / 0.1).std()) < 0.9  # recorded: 0.72 m/s^2
    assert bool((gaps > 0).all())
