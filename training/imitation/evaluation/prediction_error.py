"""Prediction error: the distance of a driver from the person whose place it takes.

As Kuefler et al. measure it, one vehicle is driven and all others are replayed; they do not react to it.

References:
    Kuefler, Morton, Wheeler and Kochenderfer, "Imitating driver behavior with generative adversarial networks",
    2017.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from training.data.trajectories import DT
from training.imitation.evaluation.behaviour import Act, drive_traffic, regular_starts
from training.imitation.traffic.recording import Recording
from training.imitation.traffic.replayed_traffic import Traffic, start_replay

TIMES = (0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 10.0)
"""Times [s] after which drivers are compared."""
ROLLOUTS = 20
"""Number of rollouts of each segment."""


class Errors(NamedTuple):
    """Differences from the record, of the n vehicles that are still recorded."""

    scene: Tensor
    """Scene of each vehicle, shape (n,), as the others."""
    position: Tensor
    """[m]."""
    speed: Tensor
    """[m/s]."""
    lateral: Tensor
    """[m]."""


def current_errors(recording: Recording, traffic: Traffic) -> Errors:
    """Return differences of driven vehicles from their recorded places at this tick."""
    at = traffic.tick.minimum(recording.ticks[traffic.scene] - 1)
    recorded = recording.present[traffic.scene, at].gather(1, traffic.vehicle)
    known = recorded & traffic.driven & (traffic.tick == at)[:, None]

    def off(name: str) -> Tensor:
        record: Tensor = getattr(recording, name)[traffic.scene, at].gather(1, traffic.vehicle)  # a field by its name
        made: Tensor = getattr(traffic, name)  # likewise
        return (made - record)[known]

    along, across = off("x"), off("y")
    scene = traffic.scene[:, None].expand_as(known)[known]
    return Errors(scene, (along.square() + across.square()).sqrt(), off("speed"), across)


def draw_segments(recording: Recording, seconds: float, each: int, generator: torch.Generator) -> tuple[Tensor, ...]:
    """Return some vehicles at moments of the record.

    Args:
        recording: The scenes.
        seconds: Time between moments [s].
        each: Largest number of vehicles at a moment.
        generator: Source of the choice.

    Returns:
        Scene, tick and vehicle of each segment, shape (n,) each.
    """
    scene, tick = regular_starts(recording, seconds)
    traffic = start_replay(recording, scene, tick)
    rank = torch.where(traffic.driven, torch.rand(traffic.driven.shape, generator=generator), 2.0).argsort(1).argsort(1)
    row, column = ((rank < each) & traffic.driven).nonzero(as_tuple=True)
    return scene[row], tick[row], traffic.vehicle[row, column]


def prediction_errors(
    recording: Recording, act: Act, chosen: tuple[Tensor, ...], rollouts: int = ROLLOUTS
) -> dict[float, Errors]:
    """Drive one vehicle of each segment several times, among replayed others, and return its errors.

    Args:
        recording: The scenes.
        act: The driver.
        chosen: Segments, as `draw_segments` returns them.
        rollouts: Number of rollouts of each segment.

    Returns:
        Errors after each of `TIMES`.
    """
    scene, tick, vehicle = (part.repeat(rollouts) for part in chosen)
    traffic = start_replay(recording, scene, tick, only=vehicle)
    ticks = {round(seconds / DT): seconds for seconds in TIMES}
    with torch.inference_mode():
        return {
            ticks[passed]: current_errors(recording, moment.traffic)
            for passed, moment in enumerate(drive_traffic(recording, traffic, act, max(ticks) + 1))
            if passed in ticks
        }
