"""The ego `vision`: imitation of a driver by rule, with corrections where the network itself drives.

    python -m training.recipes.vision --out runs/vision

Round 0 imitates the expert in its own drives. In each later round the network drives, mixed with the expert less and
less, the expert labels the pictures, and the network learns from those of all rounds (DAgger). Then it is corrected
(`ordinary_traffic.learn`): it drives failures in hard brakes, draws of the scenarios and situations of before,
and learns labels that ask for harder braking than the vehicle's, so that an error of regression about them still brakes
fully. At test time there is the network alone, which sees pictures and its own speed. The shipped file is one of
`--seed 0`, corrected in two rounds of seed 0 and one of seed 1.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from torch import Tensor, nn

from agents import Provenance
from agents.learned.driver import HEADING_TIME, OFFSET_TIME
from agents.vision import (
    ACCELERATION_UNIT,
    LAG,
    MIN_STEERING_SPEED,
    OBSERVATION,
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
from rare_envs.control.idm import IDM
from rare_envs.files import replace_text
from rare_envs.scenarios.base import load_base
from rare_envs.scenarios.registry import find_scenario
from rare_envs.sensors.camera import Weather
from rare_envs.sensors.pictures import take_picture
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import Clock, Sensing, World
from rare_envs.startup import use_one_thread
from rare_envs.traffic.state import VEHICLE_LENGTH, State
from training.command_line import RunFolderOption, run_command
from training.recipes.ordinary_traffic import Search, correct, descend, judge_all_cases, learn
from training.recipes.situations import make_situations, start_situation

VISION_EXPERT = IDM(jam_distance=2.0)
"""Treiber, Hennecke and Helbing's (2000) distance at standstill: 1 m, the suite's, leaves nothing to an imitator."""
DEMANDED_BRAKING = 10.0
"""Hardest braking that the labels of the corrections ask for [m/s^2]; the vehicle's is 5."""
SEARCHED = ("rare_envs/HardBrake-v0", "us101")
DRAWN = (
    SEARCHED,
    ("rare_envs/CutIn-v0", "us101"),
    ("rare_envs/CutIn-v1", "us101"),
    ("rare_envs/CarFollowing-v0", "us101-gap"),
)
"""Scenarios and bases in which failures are searched, and that are driven by draws."""
FIRST_TICKS, CAMERA_ROWS = 10, 64
"""Ticks at the start that are all recorded, because a short gap is braked for then or never; rows driven at once."""
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


@dataclass(frozen=True)
class CorrectionPlan:
    """Amounts of the corrections: simulations of a search, most failures driven, draws of each scenario in a round.

    Of the first training's situations the expert drives some before the first round, and the network some in each;
    drives take so many seconds.
    """

    seed: int = 0
    rounds: int = 3
    simulations: int = 600
    driven: int = 192
    draws: int = 64
    drives: tuple[int, int] = (28, 14)
    rows: int = 24
    seconds: float = 10.0
    visits: int = 30_000
    batch: int = 32
    rate: float = 3e-4


def expert_outputs(episode: Episode, brakes: float = VISION_EXPERT.max_deceleration) -> Tensor:
    """Return the outputs that the network should give, in units of `ACCELERATION_UNIT` and `TURN_UNIT`, shape (B, 2).

    Acceleration is IDM's behind the lead, with braking of up to `brakes` [m/s^2]. The yaw rate is that of
    `rare_envs.control.idm` with the road's curvature fed forward, so that it does not run wide, and with a sine of
    the heading towards the lane of at most 0.3. Below `MIN_STEERING_SPEED` it uses that speed for the curvature.
    """
    state, road = episode.state, episode.road
    speed, heading = state.speed[:, 0].clamp(min=MIN_STEERING_SPEED), state.heading[:, 0]
    offset = state.y[:, 0] - road.centre_of(state.y[:, 0])
    wanted = torch.asin((-offset / (OFFSET_TIME * speed)).clamp(-0.3, 0.3))
    turn = (wanted - heading) / HEADING_TIME + speed * road.curvature(state.x[:, 0])
    slip = torch.atan(0.5 * torch.tan(torch.tensor(MAX_STEERING)))  # of the bicycle model at full steering
    limit = speed * torch.sin(slip) / (0.5 * VEHICLE_LENGTH)
    acceleration = replace(VISION_EXPERT, max_deceleration=brakes).acceleration(state.speed[:, 0], episode.lead)
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


def drive_situations(
    network: PilotNet | None, share: float, drives: int, rows: int, ticks: int, rng: np.random.Generator, **how: Any
) -> Iterator[LabelledPictures]:
    """Yield the moments of situations, taken in turn; `network`, `share` and `how` as in `drive_and_label`."""
    situations = make_situations()
    for number in range(drives):
        start = start_situation(situations[number % len(situations)], rows, ticks * VisionEgo.dt, rng)
        yield from drive_and_label(*start, network, share, ticks, rng, **how)


@torch.inference_mode()
def drive_and_label(
    world: World,
    episode: Episode,
    network: PilotNet | None,
    share: float,
    ticks: int,
    rng: np.random.Generator,
    *,
    recorded_share: float,
    noise: float = 0.0,
    brakes: float = VISION_EXPERT.max_deceleration,
    first_ticks: int = 0,
) -> Iterator[LabelledPictures]:
    """Drive on from a moment, and yield pictures with the outputs of the expert, until egos collide.

    The network decides at a share of the ticks, the expert at the others; with None the expert drives alone. A share of
    the ticks is recorded, the first ones all. Actions have a factor of a noise of 0.5 m/s^2 and 0.05 rad/s for about
    half a second, so that places off the expert's path are seen. Labels ask for braking of up to `brakes` [m/s^2].
    """
    state, swing, before = None, np.zeros((len(episode.collided), 2)), deque([episode], LAG)
    for tick in range(ticks):
        speed, expert = episode.state.speed[:, 0], expert_outputs(episode, brakes)
        recorded = ~episode.collided & (bool(rng.random() < recorded_share) | (tick < first_ticks))
        swing = 0.8 * swing + 0.6 * rng.standard_normal(swing.shape)
        output = expert + noise * torch.from_numpy(swing * (0.25, 0.5)).float()
        if network is None:  # the expert needs no pictures: only recorded ones are taken
            if bool(recorded.any()):
                seen = _take_pictures(episode, recorded), luma(_take_pictures(before[0], recorded)), speed[recorded]
        else:
            picture = _take_pictures(episode, torch.ones_like(recorded))
            past, state = update_memory(picture, state)
            decides = torch.from_numpy(rng.random(len(speed)) < share)[:, None]
            output = torch.where(decides, network(picture, torch.from_numpy(past), speed), output)
            seen = picture[recorded], torch.from_numpy(past)[recorded.numpy()], speed[recorded]
        if bool(recorded.any()):
            yield LabelledPictures(*seen, expert[recorded], auxiliary_targets(episode)[recorded])
        before.append(episode)
        episode = world.step(episode, to_physical(to_actions(output, speed), len(speed), episode.collided))


def _take_pictures(episode: Episode, rows: Tensor) -> Tensor:
    """Take the pictures of some rows, boolean, shape (B,)."""
    assert episode.camera_context is not None
    state, context = episode.state, episode.camera_context
    weather = Weather(*(field[rows] for field in context.weather))
    context = context._replace(weather=weather, tick=context.tick[rows])
    return take_picture(State(*(field[rows] for field in state)), episode.road, context)


def draw_batch(data: LabelledPictures, size: int, rng: np.random.Generator) -> LabelledPictures:
    """Return some of the moments, left and right exchanged in half of them."""
    some = torch.from_numpy(rng.integers(0, len(data.speed), size))
    return mirror(LabelledPictures(*(field[some] for field in data)), torch.from_numpy(rng.random(size) < 0.5))


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
            some = draw_batch(data, min(plan.batch, left), rng)
            hidden = network.hidden(some.picture, some.earlier, some.speed)
            error = nn.functional.smooth_l1_loss(network.out(hidden), some.expert, beta=0.5)
            truth = nn.functional.smooth_l1_loss(probe(hidden), some.truth)
            rate = plan.rate * (0.505 + 0.495 * math.cos(math.pi * visited / all_visits))
            descend(optimiser, error + plan.truth_weight * truth, rate, MAX_GRADIENT_NORM)
            left, visited = left - len(some.speed), visited + len(some.speed)
        typer.echo(f"round {number}: {len(data.speed):,} pictures, loss {error.item():.4f}", err=True)
    return network.eval().requires_grad_(False)


def correct_vision(network: PilotNet, plan: CorrectionPlan) -> list[dict[str, Any]]:
    """Correct a network in place; return a record of each round, see `correct`."""
    rng, ticks = np.random.default_rng(plan.seed), round(plan.seconds / VisionEgo.dt)

    def situations(by: PilotNet | None, drives: int, share: float, noise: float) -> Iterator[LabelledPictures]:
        how = {"recorded_share": share, "noise": noise, "brakes": DEMANDED_BRAKING}
        return drive_situations(by, 1.0, drives, plan.rows, ticks, rng, **how)

    def scenarios(env_id: str, x: NDArray[np.float64], share: float) -> Iterator[LabelledPictures]:
        world = World(find_scenario(env_id), Sensing(OBSERVATION), clock=Clock(horizon=plan.seconds))
        how: dict[str, Any] = {"recorded_share": share, "brakes": DEMANDED_BRAKING, "first_ticks": FIRST_TICKS}
        for rows in torch.split(torch.from_numpy(x).float(), CAMERA_ROWS) if len(x) else ():
            yield from drive_and_label(world, world.start(rows), network, 1.0, ticks, rng, **how)

    data = list(situations(None, plan.drives[0], 0.06, 1.0))

    def learn_from(searches: list[Search]) -> None:
        for search in searches:
            data.extend(scenarios(search.record["env_id"], search.driven, 0.3))
        data.extend(situations(network, plan.drives[1], 0.15, 0.0))
        for env_id, base in DRAWN:
            drawn = np.asarray(load_base(find_scenario(env_id), base).sample(plan.draws, rng))
            data.extend(scenarios(env_id, drawn, 0.15))
        pictures = concatenate(data)

        def loss() -> Tensor:
            some = draw_batch(pictures, plan.batch, rng)
            given = network(some.picture, some.earlier, some.speed)
            return nn.functional.smooth_l1_loss(given, some.expert, beta=0.5)

        network.train().requires_grad_(True)
        learn(list(network.parameters()), loss, math.ceil(plan.visits / plan.batch), plan.rate, MAX_GRADIENT_NORM)
        network.eval().requires_grad_(False)

    options: dict[str, Any] = {"most": plan.driven, "max_sim": plan.simulations, "ensemble_run": False}
    return correct(lambda: VisionEgo(network), (SEARCHED,), plan.rounds, plan.seed, rng, learn_from, **options)


@use_one_thread()
def main(
    out: RunFolderOption,
    seed: Annotated[int, typer.Option(help="Of everything that is random.")] = 0,
    judged: Annotated[int, typer.Option(help="Minutes of driving in each kind of ordinary traffic to judge it.")] = 30,
) -> None:
    """Train and correct the ego `vision`; write it to OUT/vision.safetensors, with the counts in OUT/rounds.json."""
    out.mkdir(parents=True, exist_ok=True)
    network = train_vision(VisionPlan(seed=seed))
    records = correct_vision(network, CorrectionPlan(seed=seed))
    replace_text(out / "rounds.json", json.dumps(records, indent=1) + "\n")
    provenance = Provenance(
        kind="imitation of a driver by rule with on-policy corrections (DAgger), corrected",
        command=f"python -m training.recipes.vision --seed {seed} --judged {judged}",
        data="Pictures of this project's own simulations; nothing was recorded on a road.",
        data_licence="that of the project",
        metrics=judge_all_cases(VisionEgo(network), judged, JUDGE_SEED) if judged else {},
    )
    print(f"Wrote {save_vision(network, provenance, out / 'vision.safetensors')}.")


if __name__ == "__main__":
    run_command(main)
