"""MultiAgentEpisode: one traffic, seen by every vehicle as if it were the ego."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.simulation.decision import hold_finished
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import World
from rare_envs.traffic.overlap import pairwise_overlaps


class MultiAgentEpisode(NamedTuple):
    """B episodes of N vehicles at one moment."""

    traffic: Episode
    """The world's episodes, which go on as long as there is an agent."""
    views: tuple[Episode, ...]
    """The episodes as each vehicle sees them, itself in the ego's place with a lead, a measure and collisions of its
    own; after its collision they stay as they were then."""
    disabled: Tensor
    """Mask of vehicles that have crashed, or were hit by one that had, boolean, shape (B, N). A disabled vehicle
    takes no actions: it rolls out as HighwayEnv's crashed vehicles do."""

    @property
    def collided(self) -> Tensor:
        """Mask of vehicles that have touched another one or left the road by now, boolean, shape (B, N)."""
        return torch.stack([view.collided for view in self.views], dim=1)


def start(world: World, x: Tensor) -> MultiAgentEpisode:
    """Begin B episodes.

    Args:
        world: The world.
        x: Scenario parameters, as in `World.start`.
    """
    traffic = world.start(x)
    none = torch.zeros_like(traffic.state.x, dtype=torch.bool)
    traffic = traffic._replace(overridden=none)
    camera = traffic.camera_context
    others = (
        world.start_from(
            traffic.state.seen_by(j),
            _view_perception(traffic.perception, j),
            camera_context=camera and camera._replace(viewer=j),
        )
        for j in range(1, world.scenario.vehicles)
    )
    return MultiAgentEpisode(traffic, (traffic, *others), none)


def step_traffic(world: World, episode: MultiAgentEpisode, action: Tensor, commanded: Tensor) -> MultiAgentEpisode:
    """Move every vehicle by one tick.

    Contacts between vehicles that follow script or drivers are recorded, and do not change their motion, as in an
    environment of one agent. A vehicle is disabled when it touches the ego, a commanded or a disabled vehicle, which is
    disabled too; so is the ego or a commanded vehicle that leaves the road.

    Args:
        world: The world.
        episode: B episodes.
        action: Acceleration [m/s^2] and steering angle [rad] of the vehicles, shape (B, N, 2); the ego's always counts.
        commanded: Which vehicles take their action, boolean, shape (B, N).

    Returns:
        The episodes one tick later.
    """
    traffic, disabled, road = episode.traffic, episode.disabled, world.scenario.road
    active = commanded | disabled
    speed = traffic.state.speed
    rolling_out = torch.stack((-speed, torch.zeros_like(speed)), dim=-1)
    traffic = world.step(traffic, torch.where(disabled[..., None], rolling_out, action), active)
    state = traffic.state
    touching, off = pairwise_overlaps(state, road), road.off_road(state.y)
    hit = touching.any(dim=2)
    if world.measurement.collisions == "any":
        hit = hit.any(dim=1, keepdim=True)
    hit = hit | off
    views = [traffic]
    for j, view in enumerate(episode.views[1:], start=1):
        views.append(world.update(view, state.seen_by(j), _view_perception(traffic.perception, j), hit[:, j]))
    held = tuple(
        hold_finished(old.collided, old, new) if bool(old.collided.any()) else new
        for old, new in zip(episode.views, views, strict=True)
    )
    active = active | (torch.arange(active.shape[1], device=active.device) == 0)
    struck = (touching & (active[:, :, None] | active[:, None, :])).any(dim=2) | (off & active)
    return MultiAgentEpisode(traffic, held, disabled | struck)


def view_order(vehicle: int, vehicles: int) -> list[int]:
    """Return the vehicles in the order of `State.seen_by`.

    Example:
        >>> view_order(1, 3)
        [1, 0, 2]
    """
    return [vehicle, *(j for j in range(vehicles) if j != vehicle)]


def _view_perception(perception: Tensor | None, vehicle: int) -> Tensor | None:
    """Return the vehicles' lidar features in the order of `State.seen_by`."""
    return None if perception is None else perception[:, view_order(vehicle, perception.shape[1])]
