"""Lane changes in recorded scenes."""

from typing import NamedTuple

import torch
from torch import Tensor

from training.imitation.traffic.recording import Recording
from training.imitation.traffic.replayed_traffic import lane_of

SETTLED_TICKS = 10
"""Ticks that a vehicle is in one lane on either side of a crossing, at least."""


class Crossings(NamedTuple):
    """n lane changes of a recording, shape (n,) each."""

    scene: Tensor
    tick: Tensor
    """The first in the new lane."""
    vehicle: Tensor
    side: Tensor
    """1 to the right, -1 to the left."""


def find_crossings(recording: Recording) -> Crossings:
    """Return changes of lane with `SETTLED_TICKS` ticks in one lane on either side."""
    ticks = recording.x.shape[1]
    lane = torch.stack([lane_of(recording.y[:, tick], recording.edges) for tick in range(ticks)], dim=1)
    lane = torch.where(recording.present, lane, -1)
    found = []
    for tick in range(SETTLED_TICKS, ticks - SETTLED_TICKS + 1):
        before, after = lane[:, tick - SETTLED_TICKS : tick], lane[:, tick : tick + SETTLED_TICKS]
        settled = (before == before[:, -1:]).all(dim=1) & (after == after[:, :1]).all(dim=1)
        crossed = settled & (before[:, -1] >= 0) & (after[:, 0] >= 0) & (before[:, -1] != after[:, 0])
        scene, vehicle = crossed.nonzero(as_tuple=True)
        side = (after[:, 0] - before[:, -1])[scene, vehicle].sign()
        found.append(torch.stack((scene, torch.full_like(scene, tick), vehicle, side)))
    return Crossings(*torch.cat(found, dim=1))
