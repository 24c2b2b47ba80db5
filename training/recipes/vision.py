"""The ego `vision`: imitation of a driver by rule, where that and where the network itself drives.

    python -m training.recipes.vision --out runs/vision

Round 0 imitates the expert in its own drives. In each later round the network drives, mixed with the expert less and
less, the expert labels the pictures, and the network learns from those of all rounds (DAgger; Ross, Gordon and Bagnell,
AISTATS 2011). At test time there is the network alone, which sees pictures and its own speed. The shipped file is that
of `--seed 0`, corrected in three rounds on failures behind leads that braked at a constant rate: its header names the
code.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
import torch
import typer
from torch import Tensor, nn

from agents import Provenance
from agents.vision import (
    ACCELERATION_UNIT,
    LAG,
    MIN_STEERING_SPEED,
    PILOTNET_HIDDEN_UNITS,
    TURN_UNIT,
    PilotNet,
    VisionEgo,
    luma,
    save_vision,
    to_actions,
    update_memory,
)
from rare_envs.control.actions import MAX_STEERING, to_physical
from rare_envs.control.idm import IDM, TAU_HEADING, TAU_LATERAL
from rare_envs.sensors.camera import Weather
from rare_envs.sensors.pictures import take_picture
from rare_envs.simulation.episode import Episode
from rare_envs.startup import use_one_thread
from rare_envs.traffic.state import VEHICLE_LENGTH, State
from training.command_line import RunFolderOption, run_command
from training.recipes.ordinary_traffic import judge_all_cases
from training.recipes.situations import make_situations, start_situation

VISION_EXPERT = IDM(jam_distance=2.0)
"""Treiber, Hennecke and Helbing's (2000) distance at standstill: 1 m, the suite's, leaves nothing to an imitator."""
MAX_GRADIENT_NORM = 5.0
"""Norm to which gradients are clipped."""
JUDGE_SEED = 2026
"""Seed of the drives that evaluate the result, which no training uses."""


@dataclass(frozen=True)
class VisionPlan:
    """Amounts of the training; pairs are those of round 0, in which the expert drives, and of each round of DAgger.

    In round k the expert decides at a share `mixing`^k of the ticks. Of the drives, situations of so many `rows` and
    ticks, a share of the moments is `recorded`; visits are pictures that are learned from, with repetition. The rate of
    Adam falls as a cosine to a hundredth; `truth_weight` is that of the second task, see `auxiliary_targets`.
    """

    seed: int = 0
    rounds: int = 5
    drives: tuple[int, int] = (56, 7)
    rows: int = 24
    ticks: tuple[int, int] = (100, 120)
    recorded: tuple[float, float] = (0.1, 0.2)
    mixing: float = 0.5
    visits: tuple[int, int] = (40_000, 20_000)
    batch: int = 32
    rate: float = 1e-3
    truth_weight: float = 0.5


def expert_outputs(episode: Episode) -> Tensor:
    """Return the outputs that the network should give, in units of `ACCELERATION_UNIT` and `TURN_UNIT`, shape (B, 2).

    Acceleration is IDM's behind the lead. The yaw rate is that of `rare_envs.control.idm` with the road's curvature fed
    forward, so that it does not run wide, and with a sine of the heading towards the lane of at most 0.3. Below
    `MIN_STEERING_SPEED` it uses that speed for the curvature.
    """
    state, road = episode.state, episode.road
    speed, heading = state.speed[:, 0].clamp(min=MIN_STEERING_SPEED), state.heading[:, 0]
    offset = state.y[:, 0] - road.centre_of(state.y[:, 0])
    wanted = torch.asin((-offset / (TAU_LATERAL * speed)).clamp(-0.3, 0.3))
    turn = (wanted - heading) / TAU_HEADING + speed * road.curvature(state.x[:, 0])
    slip = torch.atan(0.5 * torch.tan(torch.tensor(MAX_STEERING)))  # of the bicycle model at full steering
    limit = speed * torch.sin(slip) / (0.5 * VEHICLE_LENGTH)
    acceleration = VISION_EXPERT.acceleration(state.speed[:, 0], episode.lead)
    turn = torch.maximum(torch.minimum(turn, limit), -limit)
    return torch.stack((acceleration / ACCELERATION_UNIT, turn / TURN_UNIT), dim=1)


def auxiliary_targets(episode: Episode) -> Tensor:
    """Return offset, heading, curvature, nearness and approach of the lead, in units of about 1, (B, 5)."""
    state, road, lead = episode.state, episode.road, episode.lead
    near = (10.0 / lead.gap.clamp(min=2.0)).clamp(max=3.0)
    offset = (state.y[:, 0] - road.centre_of(state.y[:, 0])) / 0.5
    curvature, approach = road.curvature(state.x[:, 0]) / 0.001, (lead.closing_speed / 5.0).clamp(-2.0, 2.0)
    return torch.stack((offset, state.heading[:, 0] / 0.05, curvature, near, near * approach), dim=1)


class LabelledPictures(NamedTuple):
    """Moments: pictures (n, 66, 200, 3) and luma of those before them (n, 66, 200), uint8; own speed [m/s] (n,).

    Then the expert's outputs (n, 2) and the auxiliary targets (n, 5).
    """

    picture: Tensor
    earlier: Tensor
    speed: Tensor
    expert: Tensor
    truth: Tensor


def concatenate(parts: list[LabelledPictures]) -> LabelledPictures:
    """Return all moments of several parts."""
    return LabelledPictures(*(torch.cat(fields) for fields in zip(*parts, strict=True)))


@torch.inference_mode()
def drive_situations(
    network: PilotNet | None,
    share: float,
    drives: int,
    rows: int,
    ticks: int,
    rng: np.random.Generator,
    *,
    recorded_share: float,
    noise: float = 0.0,
) -> Iterator[LabelledPictures]:
    """Drive in situations, taken in turn, and yield pictures with the outputs of the expert, until egos collide.

    The network decides at a share of the ticks, the expert at the others; with None the expert drives alone. A share of
    the ticks is recorded. Actions have a factor of a noise of 0.5 m/s^2 and 0.05 rad/s for about
    half a second, so that places off the expert's path are seen.
    """
    situations = make_situations()
    for number in range(drives):
        situation = situations[number % len(situations)]
        world, episode = start_situation(situation, rows, ticks * VisionEgo.dt, rng)
        state, swing, before = None, np.zeros((rows, 2)), deque([episode], LAG)
        for _ in range(ticks):
            speed, expert = episode.state.speed[:, 0], expert_outputs(episode)
            recorded = ~episode.collided & bool(rng.random() < recorded_share)
            swing = 0.8 * swing + 0.6 * rng.standard_normal(swing.shape)
            output = expert + noise * torch.from_numpy(swing * (0.25, 0.5)).float()
            if network is None:  # the expert needs no pictures: only recorded ones are taken
                if bool(recorded.any()):
                    seen = _take_pictures(episode, recorded), luma(_take_pictures(before[0], recorded)), speed[recorded]
            else:
                picture = _take_pictures(episode, torch.ones_like(recorded))
                past, state = update_memory(picture, state)
                decides = torch.from_numpy(rng.random(rows) < share)[:, None]
                output = torch.where(decides, network(picture, torch.from_numpy(past), speed), output)
                seen = picture[recorded], torch.from_numpy(past)[recorded.numpy()], speed[recorded]
            if bool(recorded.any()):
                yield LabelledPictures(*seen, expert[recorded], auxiliary_targets(episode)[recorded])
            before.append(episode)
            episode = world.step(episode, to_physical(to_actions(output, speed), rows, episode.collided))


def _take_pictures(episode: Episode, rows: Tensor) -> Tensor:
    """Take the pictures of some rows, boolean, shape (B,)."""
    assert episode.camera_context is not None
    state, context = episode.state, episode.camera_context
    weather = Weather(*(field[rows] for field in context.weather))
    context = context._replace(weather=weather, tick=context.tick[rows])
    return take_picture(State(*(field[rows] for field in state)), episode.road, context)


def mirror(pictures: LabelledPictures, rows: Tensor) -> LabelledPictures:
    """Exchange left and right in some rows, boolean, shape (n,)."""
    sign = torch.where(rows, -1.0, 1.0)[:, None]
    one = torch.ones_like(sign)
    picture, earlier = pictures.picture.clone(), pictures.earlier.clone()
    picture[rows], earlier[rows] = picture[rows].flip(2), earlier[rows].flip(2)
    expert = pictures.expert * torch.cat((one, sign), dim=1)
    truth = pictures.truth * torch.cat((sign, sign, sign, one, one), dim=1)
    return LabelledPictures(picture, earlier, pictures.speed, expert, truth)


def train_vision(plan: VisionPlan) -> PilotNet:
    """Return a network after all rounds of DAgger."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(plan.seed)
        network, probe = PilotNet(), nn.Linear(PILOTNET_HIDDEN_UNITS, 5)
    optimiser = torch.optim.Adam([*network.parameters(), *probe.parameters()], plan.rate)
    all_visits, visited = plan.visits[0] + plan.rounds * plan.visits[1], 0
    recorded: list[LabelledPictures] = []
    for number in range(plan.rounds + 1):
        rng, later = np.random.default_rng((plan.seed, number)), int(number > 0)
        share, drives, ticks = 1.0 - plan.mixing**number, plan.drives[later], plan.ticks[later]
        how = {"recorded_share": plan.recorded[later], "noise": 0.0 if later else 1.0}
        recorded += drive_situations(network if later else None, share, drives, plan.rows, ticks, rng, **how)
        data, left = concatenate(recorded), plan.visits[later]
        while left > 0:
            size = min(plan.batch, left)
            drawn = torch.from_numpy(rng.integers(0, len(data.speed), size))
            turned = torch.from_numpy(rng.random(size) < 0.5)  # left and right are exchanged in half of them
            some = mirror(LabelledPictures(*(field[drawn] for field in data)), turned)
            hidden = network.hidden(some.picture, some.earlier, some.speed)
            error = nn.functional.smooth_l1_loss(network.out(hidden), some.expert, beta=0.5)
            truth = nn.functional.smooth_l1_loss(probe(hidden), some.truth)
            rate = plan.rate * (0.505 + 0.495 * math.cos(math.pi * visited / all_visits))
            for group in optimiser.param_groups:
                group["lr"] = rate
            optimiser.zero_grad()
            torch.autograd.backward(error + plan.truth_weight * truth)
            nn.utils.clip_grad_norm_((*network.parameters(), *probe.parameters()), MAX_GRADIENT_NORM)
            optimiser.step()
            left, visited = left - len(some.speed), visited + len(some.speed)
        typer.echo(f"round {number}: {len(data.speed):,} pictures, loss {error.item():.4f}", err=True)
    return network.eval().requires_grad_(False)


@use_one_thread()
def main(
    out: RunFolderOption,
    seed: Annotated[int, typer.Option(help="Of everything that is random.")] = 0,
    judged: Annotated[int, typer.Option(help="Minutes of driving in each kind of ordinary traffic to judge it.")] = 30,
) -> None:
    """Train the ego `vision`; write it to OUT/vision.safetensors."""
    out.mkdir(parents=True, exist_ok=True)
    network = train_vision(VisionPlan(seed=seed))
    provenance = Provenance(
        kind="imitation of a driver by rule with on-policy corrections (DAgger)",
        command=f"python -m training.recipes.vision --seed {seed} --judged {judged}",
        data="Pictures of this project's own simulations; nothing was recorded on a road.",
        data_licence="that of the project",
        metrics=judge_all_cases(VisionEgo(network), judged, JUDGE_SEED) if judged else {},
    )
    print(f"Wrote {save_vision(network, provenance, out / 'vision.safetensors')}.")


if __name__ == "__main__":
    run_command(main)
