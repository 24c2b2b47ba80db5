"""Data set of the ego `vision`: pictures of drives with the expert's outputs."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from agents.vision import LAG, PilotNet, VisionEgo, luma, to_actions, update_memory
from rare_envs.control.actions import to_physical
from rare_envs.sensors.camera import Weather, take_picture
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import World
from rare_envs.traffic.state import State
from training.egos.curriculum import make_situations, start_situation
from training.egos.expert_driver import EXPERT_BRAKES, auxiliary_targets, expert_outputs

SWING_CORRELATION, SWING_SCALE = 0.8, 0.6
"""Of the noise from tick to tick, with variance 1: it lasts for 0.1 s / -log(0.8), about half a second."""
SWING_STD = (0.25, 0.5)
"""Standard deviations of the noise in units of the outputs: 0.5 m/s^2 and 0.05 rad/s."""


class LabelledPictures(NamedTuple):
    """Pictures and labels of n moments."""

    picture: Tensor
    """uint8, shape (n, 66, 200, 3)."""
    earlier: Tensor
    """Luma of the picture before it, uint8, shape (n, 66, 200)."""
    speed: Tensor
    """Own speed [m/s], shape (n,)."""
    expert: Tensor
    """Outputs of the expert, as `training.egos.expert_driver.expert_outputs` returns them, shape (n, 2)."""
    truth: Tensor
    """Auxiliary targets, as `training.egos.expert_driver.auxiliary_targets` returns them, shape (n, 5)."""

    def rows(self, rows: Any) -> LabelledPictures:
        """Return some of the moments."""
        return LabelledPictures(*(field[rows] for field in self))


def concatenate(parts: list[LabelledPictures]) -> LabelledPictures:
    """Return all moments of several parts."""
    return LabelledPictures(*(torch.cat(fields) for fields in zip(*parts, strict=True)))


@torch.inference_mode()
def collect(
    network: PilotNet | None,
    network_share: float,
    *,
    drives: int,
    rows: int,
    ticks: int,
    recorded_share: float,
    noise: float,
    rng: np.random.Generator,
    brakes: float = EXPERT_BRAKES,
) -> Iterator[LabelledPictures]:
    """Drive, and yield pictures with the outputs of the expert.

    Args:
        network: Drives together with the expert; with None the expert drives alone.
        network_share: Share of the ticks at which the network decides.
        drives: Number of situations, taken in turn.
        rows: Number of scenarios in each.
        ticks: Length of each scenario in ticks of 0.1 s.
        recorded_share: Share of the ticks that are recorded.
        noise: Factor of the noise of the actions, `SWING_STD`, which lasts for half a second, so that places off the
            expert's path are seen.
        rng: Source of everything that is random.
        brakes: Hardest braking that the labels ask for [m/s^2], see `training.egos.expert_driver.expert_outputs`.

    Yields:
        The moments of each situation.
    """
    situations = make_situations()
    for number in range(drives):
        world, episode = start_situation(situations[number % len(situations)], rows, ticks * VisionEgo.dt, rng)
        moments = drive_and_label(world, episode, network, network_share, ticks, recorded_share, noise, rng, brakes)
        yield concatenate(list(moments))


def drive_and_label(
    world: World,
    episode: Episode,
    network: PilotNet | None,
    network_share: float,
    ticks: int,
    recorded_share: float,
    noise: float,
    rng: np.random.Generator,
    brakes: float = EXPERT_BRAKES,
    first_ticks: int = 0,
) -> Iterator[LabelledPictures]:
    """Yield the recorded moments of one situation, all of the first ticks; the other arguments as in `collect`."""
    state, swing, before = None, np.zeros((len(episode.collided), 2)), deque([episode], LAG)
    for tick in range(ticks):
        speed, expert = episode.state.speed[:, 0], expert_outputs(episode, brakes)
        recorded = ~episode.collided & (bool(rng.random() < recorded_share) | (tick < first_ticks))
        swing = SWING_CORRELATION * swing + SWING_SCALE * rng.standard_normal(swing.shape)
        output = expert + noise * torch.from_numpy(swing * SWING_STD).float()
        if network is None:  # the expert needs no pictures: only recorded ones are taken
            if bool(recorded.any()):
                seen = _take_pictures(episode, recorded), luma(_take_pictures(before[0], recorded)), speed[recorded]
        else:
            picture = _take_pictures(episode, torch.ones_like(recorded))
            past, state = update_memory(picture, state)
            decides = torch.from_numpy(rng.random(len(speed)) < network_share)[:, None]
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


def mirror(pictures: LabelledPictures, rows: Tensor) -> LabelledPictures:
    """Exchange left and right in some rows, boolean, shape (n,)."""
    sign = torch.where(rows, -1.0, 1.0)[:, None]
    one = torch.ones_like(sign)
    picture, earlier = pictures.picture.clone(), pictures.earlier.clone()
    picture[rows], earlier[rows] = picture[rows].flip(2), earlier[rows].flip(2)
    return LabelledPictures(
        picture,
        earlier,
        pictures.speed,
        pictures.expert * torch.cat((one, sign), dim=1),
        pictures.truth * torch.cat((sign, sign, sign, one, one), dim=1),
    )
