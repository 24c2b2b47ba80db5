"""Episodes of several agents: one traffic, lived by every vehicle as if it were the ego."""

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
    """The episodes as each vehicle lives them, itself in the ego's place with a lead, a measure and collisions of its
    own; after its collision they stay as they were then."""
    disabled: Tensor
    """Whose agent has crashed, or who was hit by one that did, boolean, shape (B, N). A wreck obeys nobody: it rolls
    out as HighwayEnv's crashed vehicles do."""

    @property
    def collided(self) -> Tensor:
        """Who has touched another vehicle or left the road by now, boolean, shape (B, N)."""
        return torch.stack([view.collided for view in self.views], dim=1)


def start(world: World, x: Tensor) -> MultiAgentEpisode:
    """Begin B episodes; x as in `World.start`."""
    own = world.start(x)
    nobody = torch.zeros_like(own.state.x, dtype=torch.bool)
    own = own._replace(overridden=nobody)
    others = (
        world.start_from(
            own.state.seen_by(j),
            _seen_by(own.perception, j),
            camera_context=own.camera_context and own.camera_context._replace(viewer=j),
        )
        for j in range(1, world.scenario.vehicles)
    )
    return MultiAgentEpisode(own, (own, *others), nobody)


def step_traffic(world: World, episode: MultiAgentEpisode, action: Tensor, commanded: Tensor) -> MultiAgentEpisode:
    """Move every vehicle by one tick.

    Contacts between vehicles that keep to script or drivers are noted, and do not change their motion, as in an
    environment of one agent. Whoever touches the ego, a commanded vehicle or a wreck is a wreck, and so is the other;
    and so is the ego or a commanded vehicle that leaves the road.

    Args:
        world: The world.
        episode: B episodes.
        action: Acceleration [m/s^2] and steering angle [rad] of the vehicles, shape (B, N, 2); the ego's always counts.
        commanded: Which of them obey it, boolean, shape (B, N).

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
        views.append(world.update(view, state.seen_by(j), _seen_by(traffic.perception, j), hit[:, j]))
    lived = tuple(
        hold_finished(old.collided, old, new) if bool(old.collided.any()) else new
        for old, new in zip(episode.views, views, strict=True)
    )
    active = active | (torch.arange(active.shape[1], device=active.device) == 0)
    struck = (touching & (active[:, :, None] | active[:, None, :])).any(dim=2) | (off & active)
    return MultiAgentEpisode(traffic, lived, disabled | struck)


def view_order(vehicle: int, vehicles: int) -> list[int]:
    """The vehicles in the order of `State.seen_by`."""
    return [vehicle, *(j for j in range(vehicles) if j != vehicle)]


def _seen_by(perception: Tensor | None, vehicle: int) -> Tensor | None:
    """What the vehicles see, in the order of `State.seen_by`."""
    return None if perception is None else perception[:, view_order(vehicle, perception.shape[1])]
