"""Traces have the moments of the drive, and measures of a whole episode see them."""

import pytest
import torch
from torch import Tensor

from rare_envs.measures import (
    Measure,
    Moment,
    Trace,
    TraceMeasure,
    ttc,
)
from rare_envs.simulation.rollout import drive
from tests.rare_envs.measures.moments import CLOSE, HIT, f, problem


def test_functions_of_a_moment_and_of_an_episode() -> None:
    def gap(moment: Moment) -> Tensor:
        return moment.lead.gap

    def mean_speed(trace: Trace) -> Tensor:
        speed, valid = trace.state.speed[:, :, 0], trace.valid
        return (speed * valid).sum(0) / valid.sum(0)

    assert f(gap, *CLOSE) == pytest.approx(0.5, abs=1e-4)
    assert f(gap, *HIT) == -1.0
    assert f(Measure(gap, collision=None), *HIT) == pytest.approx(0.5, abs=1e-4)  # the last moment before
    assert f(TraceMeasure(mean_speed), *CLOSE) == pytest.approx(20.0)
    assert f(TraceMeasure(mean_speed, critical=30.0), *CLOSE) == pytest.approx(10.0)
    assert f(TraceMeasure(mean_speed), *HIT) == -1.0


def test_a_trace_has_the_moments_of_the_drive() -> None:
    seen: list[Trace] = []

    def keep(trace: Trace) -> Tensor:
        seen.append(trace)
        return trace.of(ttc).amin(0)

    world = problem(TraceMeasure(keep, collision=None)).world
    x = torch.tensor([HIT, CLOSE])
    episodes = list(drive(world, problem("ttc").driver, x))
    values = episodes[-1].f
    last = seen[-1]
    assert last.state.x.shape == (101, 2, 2)
    assert last.valid.sum(0).tolist() == [62, 101]  # contact at 6.05 s
    assert last.collided.tolist() == [True, False]
    for k, episode in enumerate(episodes):
        torch.testing.assert_close(last.state.x[k, 1], episode.state.x[1], rtol=0, atol=0)
        torch.testing.assert_close(last.of(ttc)[k, 1], ttc(Moment(*episode[:2], episode.road, None))[1], rtol=0, atol=0)
    assert (last.state.x[62:, 0] == last.state.x[61, 0]).all()  # what came after the collision is not shown
    assert values[1] == pytest.approx(f("ttc", *CLOSE))
    assert last.time[-1].item() == pytest.approx(10.0)
