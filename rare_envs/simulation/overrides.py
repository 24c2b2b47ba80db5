"""Overrides: vehicles around the ego that take an agent's actions, and what drives them afterwards."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rare_envs.control.idm import IDM
from rare_envs.scenarios.base import Others, drive_points
from rare_envs.traffic.neighbours import lead_of
from rare_envs.traffic.vehicle_models import bicycle

if TYPE_CHECKING:
    from rare_envs.simulation.episode import Episode

_RULE = IDM()


def apply_overrides(
    episode: "Episode",
    action: Tensor,
    commanded: Tensor | None,
    scripted: Others,
    driver_actions: Tensor | None,
    dt: float,
) -> tuple[Others, Tensor]:
    """Return the other vehicles after a tick in which some of them take an agent's actions.

    Args:
        episode: B episodes before the tick.
        action: Acceleration [m/s^2] and steering angle [rad] of all vehicles, shape (B, N, 2).
        commanded: Which of them take it, boolean, shape (B, N); None for none.
        scripted: Where the script or the drivers take vehicles that were never commanded.
        driver_actions: Accelerations and yaw rates by the world's drivers, shape (B, N - 1, 2); None if it has none.
        dt: Tick [s].

    Returns:
        The others, and who has been commanded by now, boolean, shape (B, N).
    """
    state, road = episode.state, episode.road
    if commanded is None:
        commanded = torch.zeros_like(state.x, dtype=torch.bool)
        action = torch.zeros_like(state.x)[..., None].expand(-1, -1, 2)
    overridden = commanded if episode.overridden is None else commanded | episode.overridden
    released = (overridden & ~commanded)[:, 1:]
    if bool(released.any()):
        if driver_actions is None:
            action = torch.where((overridden & ~commanded)[..., None], rule_based_actions(episode), action)
            commanded = overridden
        else:
            scripted = _choose(released, drive_points(state, driver_actions, dt, road), scripted)
    x, y, heading, speed = (field[:, 1:] for field in state[:4])
    curvature = None if road.reference_line is None else road.curvature(x)
    moved = Others(*bicycle(x, y, heading, speed, action[:, 1:, 0], action[:, 1:, 1], dt, curvature))
    return _choose(commanded[:, 1:], moved, scripted), overridden


def rule_based_actions(episode: "Episode") -> Tensor:
    """Return what IDM and lane keeping do in each vehicle's place.

    Args:
        episode: B episodes.

    Returns:
        Acceleration [m/s^2] and steering angle [rad], shape (B, N, 2).
    """
    actions = []
    for vehicle in range(episode.state.x.shape[1]):
        state = episode.state.seen_by(vehicle)
        view = episode._replace(state=state, lead=lead_of(state, episode.road))
        actions.append(_RULE.act(view, None)[0])
    return torch.stack(actions, dim=1)


def _choose(which: Tensor, one: Others, other: Others) -> Others:
    """Return one where `which` is set, boolean, shape (B, N - 1), and the other elsewhere."""
    return Others(*(torch.where(which, a, b) for a, b in zip(one, other, strict=True)))
