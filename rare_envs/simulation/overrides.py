"""Vehicles around the ego that are commanded, and what drives them once nobody commands them any longer."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rare_envs.control.idm import IDM
from rare_envs.scenarios.base import Others, roaming
from rare_envs.traffic.lead import lead_of
from rare_envs.traffic.vehicle_models import bicycle

if TYPE_CHECKING:
    from rare_envs.simulation.episode import Episode

_RULE = IDM()


def led(
    episode: "Episode", action: Tensor, commanded: Tensor | None, kept: Others, decided: Tensor | None, dt: float
) -> tuple[Others, Tensor]:
    """The other vehicles after a tick in which some of them obey commands.

    Args:
        episode: B episodes before the tick.
        action: Acceleration [m/s^2] and steering angle [rad] of all vehicles, shape (B, N, 2).
        commanded: Which of them obey, boolean, shape (B, N); None for nobody.
        kept: Where vehicles would be that have always kept to script or drivers.
        decided: What the world's drivers want, accelerations and yaw rates, shape (B, N - 1, 2); None if it has none.
        dt: Tick [s].

    Returns:
        The others, and who has been commanded by now, boolean, shape (B, N).
    """
    state, road = episode.state, episode.road
    if commanded is None:
        commanded = torch.zeros_like(state.x, dtype=torch.bool)
        action = torch.zeros_like(state.x)[..., None].expand(-1, -1, 2)
    strayed = commanded if episode.strayed is None else commanded | episode.strayed
    alone = (strayed & ~commanded)[:, 1:]
    if bool(alone.any()):
        if decided is None:
            action = torch.where((strayed & ~commanded)[..., None], by_rule(episode), action)
            commanded = strayed
        else:
            kept = _choose(alone, roaming(state, decided, dt, road), kept)
    x, y, heading, speed = (field[:, 1:] for field in state[:4])
    curvature = None if road.curve is None else road.curvature(x)
    moved = Others(*bicycle(x, y, heading, speed, action[:, 1:, 0], action[:, 1:, 1], dt, curvature))
    return _choose(commanded[:, 1:], moved, kept), strayed


def by_rule(episode: "Episode") -> Tensor:
    """What IDM and lane keeping would do in each vehicle's place: acceleration and steering angle, shape (B, N, 2)."""
    actions = []
    for vehicle in range(episode.state.x.shape[1]):
        state = episode.state.seen_by(vehicle)
        view = episode._replace(state=state, lead=lead_of(state, episode.road))
        actions.append(_RULE.act(view, None)[0])
    return torch.stack(actions, dim=1)


def _choose(which: Tensor, one: Others, other: Others) -> Others:
    return Others(*(torch.where(which, a, b) for a, b in zip(one, other, strict=True)))
