"""The world: a scenario with its clock and its measure, as pure functions from episode to episode."""

from dataclasses import dataclass
from numbers import Real
from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.dynamics import bicycle
from rare_envs.geometry import Lead, ego_overlaps, lead_of
from rare_envs.measures import COLLISION, MEASURES
from rare_envs.road import Road
from rare_envs.scenarios import Scenario
from rare_envs.state import State


class Episode(NamedTuple):
    """B episodes at one moment."""

    state: State
    lead: Lead
    """The ego's lead in this state."""
    danger: Tensor
    """Least measure over the states so far, shape (B,); without meaning once collided."""
    collided: Tensor
    """Whether the ego has collided by now, boolean, shape (B,)."""
    road: Road
    """The road that all are on."""

    @property
    def f(self) -> Tensor:
        """The safety measure of the episode so far: -1 after a collision, else the least measure, shape (B,)."""
        return torch.where(self.collided, COLLISION, self.danger)


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


@dataclass(frozen=True)
class World:
    """A scenario, its tick and its measure. Nothing here changes, and nothing is random."""

    scenario: Scenario
    dt: float = 0.1
    """Tick [s]."""
    horizon: float | None = None
    """Length of an episode [s]; None takes the scenario's."""
    measure: str = "ttc"

    def __post_init__(self) -> None:
        if not (_is_number(self.dt) and 0.0 < self.dt <= 1.0):
            raise ValueError(f"Expected dt in (0, 1] s, got {self.dt!r}.")
        if self.horizon is None:
            object.__setattr__(self, "horizon", self.scenario.horizon)
        whole = _is_number(self.horizon) and self.dt <= self.seconds < 1e6
        if not whole or abs(self.seconds / self.dt - self.ticks) > 1e-6:
            raise ValueError(f"Expected a horizon of one or more whole ticks of {self.dt} s, got {self.horizon!r}.")
        if not isinstance(self.measure, str) or self.measure not in MEASURES:
            raise ValueError(f"Unknown measure {self.measure!r}; the measures are {', '.join(MEASURES)}.")

    @property
    def seconds(self) -> float:
        """Length of an episode [s]."""
        return self.scenario.horizon if self.horizon is None else self.horizon

    @property
    def ticks(self) -> int:
        """Length of an episode in ticks."""
        return round(self.seconds / self.dt)

    def start(self, x: Tensor) -> Episode:
        """Begin B episodes.

        Args:
            x: Scenario parameters, shape (B, d), within the physical box; dtype and device are kept.

        Returns:
            The episodes at time 0.
        """
        state = self.scenario.initial(x)
        road = self.scenario.road
        lead = lead_of(state, road)
        danger = MEASURES[self.measure](state, lead, road)
        return Episode(state, lead, danger, torch.zeros_like(danger, dtype=torch.bool), road)

    def step(self, episode: Episode, action: Tensor) -> Episode:
        """Move every vehicle by one tick: all decide on the old state, then all move.

        A collision (a vehicle's body overlaps the ego's, or the ego's centre leaves the road, which is walled) is
        remembered; whoever steps on after it gets motion without meaning, but an unchanged f.

        Args:
            episode: B episodes.
            action: Acceleration [m/s^2] and steering angle [rad] of the ego, shape (B, 2).

        Returns:
            The episodes one tick later.
        """
        old, dt, road = episode.state, self.dt, episode.road
        ego = (old.x[:, 0], old.y[:, 0], old.heading[:, 0], old.speed[:, 0])
        curvature = None if road.curve is None else road.curvature(old.x[:, 0])
        moved = bicycle(*ego, action[:, 0], action[:, 1], dt, curvature)
        x, y, heading, speed = (
            torch.cat((first[None], rest.T)).T for first, rest in zip(moved, self.scenario.others(old, dt), strict=True)
        )
        state = State(x, y, heading, speed, old.theta)
        lead = lead_of(state, road)
        collided = episode.collided | ego_overlaps(state, road).any(dim=1) | road.off_road(state.y[:, 0])
        danger = torch.minimum(episode.danger, MEASURES[self.measure](state, lead, road))
        return Episode(state, lead, danger, collided, road)
