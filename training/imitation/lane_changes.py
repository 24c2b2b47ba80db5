"""A driver with lane changes: their hazard is fitted to recorded ones, its weights stay as they are.

    python -m training.imitation.lane_changes DATA --out mgail3.safetensors [--driver mgail2] [--damping 0.2]

Logistic regression of the moments at which a change begins, `BEFORE` its crossing, against other moments in which one
could begin, with a penalty on the slopes. The scenes were picked for lane changes, so the constant is not theirs: it is
set such that the mean hazard in the same moments is that of complete recordings (prior correction; King and Zeng,
"Logistic regression in rare events data", 2001), and so is its fall with speed: `RATES`. Beside that, the noise gets
another damping and begins balanced, and what the network brakes beyond 2 m/s^2 is scaled, such that hard brakes are as
frequent as people's in the scenes learned from.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
import typer
from torch import Tensor

from agents import LearnedDriver
from agents.learned.adjacent_lanes import look_aside
from agents.learned.lane_changes import COVARIATES, USUAL_SPEED, LaneChanges
from rare_envs.threads import use_one_thread
from training.command_line import report_errors, run_command
from training.data.trajectories import DT
from training.imitation.datasets import Source, load_scenes
from training.imitation.noise_damping import damp_acceleration, load_learned_driver, write_derived
from training.imitation.traffic.crossings import find_crossings
from training.imitation.traffic.recording import Recording, stack_scenes
from training.imitation.traffic.replayed_traffic import lane_of, replay_features, start_replay

BEFORE = 1.4
"""Median of the time from the beginning of a change to its crossing, in the scenes learned from [s]."""
AROUND = (4.0, 3.0)
"""Moments this long before or after a crossing are not among the others [s]."""
EVERY = 5
"""Of the other moments every so many-th tick is used."""
PENALTY = 1.0
"""Precision of a normal prior of the slopes."""
RATES = ((9.7, 0.025), (6.5, 0.039))
"""Mean speed [m/s], and lane changes per vehicle and 10 s, of the complete recordings of US 101 and of I-80."""
HARD_BRAKING = 0.7
"""With .7 the rate of hard brakes is .0005 in the scenes learned from, people's .0006."""


class ChangeMoments(NamedTuple):
    """Moments of n vehicles and either side, from the scenes."""

    covariates: Tensor
    """Shape (n, 2, 5)."""
    open: Tensor
    """Whether a change to that side could begin: a lane, gaps and speed, shape (n, 2)."""
    begins: Tensor
    """Whether one does, shape (n, 2)."""
    other: Tensor
    """Whether no crossing is near, shape (n,)."""


def collect_moments(recording: Recording, changes: LaneChanges) -> ChangeMoments:
    """Return all moments in which a change begins, and some of the others."""
    scenes, ticks, vehicles = recording.x.shape
    begins = torch.zeros(scenes, ticks, vehicles, 2, dtype=torch.bool)
    other = torch.ones(scenes, ticks, vehicles, dtype=torch.bool)
    before, after = (round(seconds / DT) for seconds in AROUND)
    for scene, tick, vehicle, side in zip(*(column.tolist() for column in find_crossings(recording)), strict=True):
        other[scene, max(tick - before, 0) : tick + after, vehicle] = False
        if tick >= round(BEFORE / DT):
            begins[scene, tick - round(BEFORE / DT), vehicle, int(side > 0)] = True
    rows: list[tuple[Tensor, ...]] = []
    for tick in range(int(recording.ticks.max())):
        here = recording.ticks > tick
        scene = here.nonzero()[:, 0]
        traffic = start_replay(recording, scene, torch.full_like(scene, tick))
        m = traffic.drivers
        vehicle, lane = traffic.vehicle[:, :m], lane_of(traffic.y, traffic.edges)[:, :m]
        event = begins[scene, tick].gather(1, vehicle[..., None].expand(-1, -1, 2))
        free = other[scene, tick].gather(1, vehicle)
        chosen = traffic.driven[:, :m] & (event.any(dim=-1) | (free & (tick % EVERY == 0)))
        features = replay_features(traffic, m)[chosen]
        lanes = look_aside(features)
        last = (traffic.edges[:, 1:] > traffic.edges[:, :-1]).sum(dim=1, keepdim=True) - 1
        exists = torch.stack((lane > 0, lane < last), dim=-1)[chosen]
        may = changes.may_begin(features, lanes) & exists
        rows.append((changes.covariates(features, lanes), may, event[chosen], free[chosen]))
    return ChangeMoments(*(torch.cat(column) for column in zip(*rows, strict=True)))


def fit_logistic(inputs: Tensor, outcome: Tensor, penalty: float = PENALTY) -> Tensor:
    """Return coefficients (k,) of a logistic regression; the first input is 1, and not penalised.

    Args:
        inputs: Shape (n, k).
        outcome: 0 or 1, shape (n,).
        penalty: Of half the squares of the other coefficients.

    Example:
        >>> inputs = torch.tensor([[1.0, 0.0]] * 4 + [[1.0, 1.0]] * 4)
        >>> outcome = torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 1.0])
        >>> fit_logistic(inputs, outcome, penalty=0.0).exp()  # odds of 1 to 3, and 9 times as high
        tensor([0.3333, 9.0000], dtype=torch.float64)
    """
    from sklearn.linear_model import LogisticRegression  # here, because importing it takes a second

    strength = 1.0 / penalty if penalty else math.inf
    model = LogisticRegression(C=strength, solver="newton-cholesky", tol=1e-10)
    model.fit(inputs[:, 1:].double().numpy(), outcome.numpy())
    return torch.from_numpy(np.concatenate((model.intercept_, model.coef_[0])))


def fit_hazard(moments: ChangeMoments) -> tuple[float, ...]:
    """Return the coefficients of the hazard [1/s], whose mean over the other moments is that of `RATES`."""
    (fast, seldom), (slow, often) = RATES
    fall = math.log(seldom / often) / (fast - slow)
    used = moments.open & (moments.begins | moments.other[:, None])
    found = fit_logistic(moments.covariates[used][:, :-1], moments.begins[used].float())
    found = torch.cat((torch.zeros(1), found[1:], torch.tensor([fall])))
    covariates = moments.covariates[moments.other].double()
    hazard = torch.where(moments.open[moments.other], (covariates @ found).exp(), 0.0).sum(dim=-1)
    speed = covariates[:, 0, -1] + USUAL_SPEED
    wanted = 0.1 * seldom * (fall * (speed - fast)).exp()
    constant = math.log(float(wanted.mean() / hazard.mean()))
    return tuple(round(value, 3) for value in (constant, *found[1:].tolist()))


def add_changes(
    driver: LearnedDriver, coefficients: tuple[float, ...], damping: float, hard_braking: float, name: str
) -> LearnedDriver:
    """Return a driver with lane changes, balanced noise of another damping [1/s], eased braking and another name."""
    colour = replace(damp_acceleration(driver.colour, damping), balanced=True)
    changes = LaneChanges(coefficients=coefficients)
    return replace(driver, colour=colour, hard_braking=hard_braking, changes=changes, name=name)


def write_changing_driver(
    of: str, coefficients: tuple[float, ...], damping: float, hard_braking: float, test: Recording, out: Path
) -> Path:
    """Write a driver with lane changes, measured in the test scenes.

    Args:
        of: Name or file of the driver without them.
        coefficients: Of their hazard.
        damping: Of the acceleration's noise [1/s].
        hard_braking: Share of what it brakes beyond 2 m/s^2.
        test: Scenes that it has not learned from.
        out: File to write, .safetensors.

    Raises:
        ValueError: The driver is a rule.
    """
    made = add_changes(load_learned_driver(of), coefficients, damping, hard_braking, out.stem)
    return write_derived(made, of, damping, "lane changes", "lane_changes", test, out)


@use_one_thread()
def main(
    data: Annotated[Path, typer.Argument(help="Folder with the compact tables of US 101.")],
    out: Annotated[Path, typer.Option(help="File to write, .safetensors.")],
    driver: Annotated[str, typer.Option(help="Name or file of a learned driver with the rule.")] = "mgail2",
    damping: Annotated[float, typer.Option(help="Of the acceleration's noise [1/s].")] = 0.2,
    hard_braking: Annotated[float, typer.Option(help="Share of the braking beyond 2 m/s^2.")] = HARD_BRAKING,
) -> None:
    """Fit the hazard of lane changes, and write a driver with it."""
    with report_errors("lane_changes"):
        learn, test = (stack_scenes(scenes) for scenes in load_scenes(Source("data", data)))
        moments = collect_moments(learn, LaneChanges())
        coefficients = fit_hazard(moments)
        fitted = ", ".join(f"{name} {value:g}" for name, value in zip(COVARIATES, coefficients, strict=True))
        print(f"Hazard from {int((moments.begins & moments.open).sum())} changes: {fitted}.")
        print(f"Saved {write_changing_driver(driver, coefficients, damping, hard_braking, test, out)}.")


if __name__ == "__main__":
    run_command(main)
