"""The ego "human": an attentive human driver, whose errors of estimation and glances are noise columns of x."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from rare_envs.control.human_driver import (
    MOST_URGENT_GLANCE,
    Glances,
    HumanDriverModel,
    Percept,
    anticipate,
    count_glance_draws,
    draw_glances,
    estimate_leads,
    in_wandering_zone,
    inverse_tau,
    look,
    respond,
    step_errors,
)
from rare_envs.control.idm import lane_keeping
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import World

ERROR_STEP = 0.5
"""The errors of estimation are held for this long [s], a fortieth of their correlation time."""
FIXED_HUMAN_SEED = 12345
"""Seed of the one sequence of draws of `noise="fixed"`; any number would do."""
_ALWAYS = 10**6
"""Ticks for which a vehicle that begins in the ego's lane has been noticed."""


@dataclass(frozen=True)
class HumanEgo:
    """An attentive human driver; a `DrivingProblem` turns it into a driver of its world."""

    model: HumanDriverModel = field(default_factory=HumanDriverModel)
    """Its parameters."""

    def noise_columns(self, world: World) -> int:
        """Return how many standard normal columns of x are its noise in a world."""
        return self.in_world(world).noise_columns

    def in_world(self, world: World) -> HumanDriver:
        """Return the driver that it is in a world."""
        if world.clock.action != "continuous":
            raise ValueError(f'Expected action="continuous" for the ego "human", got {world.clock.action!r}.')
        driver = HumanDriver(self.model, world)
        if world.noise != "fixed":
            return driver
        generator = torch.Generator().manual_seed(FIXED_HUMAN_SEED)
        return driver.with_draws(torch.randn(1, sum(driver.draws), generator=generator))


class _HumanMemory(NamedTuple):
    """Memory of B drivers between two ticks; V other vehicles."""

    tick: int
    """Of the next action."""
    since: Tensor
    """Ticks for which each vehicle has been in the wandering zone or the lane, -1 outside of it, int64, (B, V)."""
    past: tuple[tuple[Percept, Tensor, Tensor], ...]
    """What there was to see, own speed and own acceleration, up to the reaction time ago, the oldest first."""
    glance: Tensor
    """Number of the glance that is due, int64, (B,), and ..."""
    away: Tensor
    """... whether the eyes are off the road, boolean, (B,)."""
    known: Percept
    """What was seen last, carried forward at constant speeds while the eyes were off the road."""
    late_speed: Tensor
    """Own speed at the moment that `known` is about [m/s], (B,)."""
    acceleration: Tensor
    """Present acceleration [m/s^2], (B,)."""


@dataclass(frozen=True)
class HumanDriver:
    """An attentive human driver in a world."""

    model: HumanDriverModel
    world: World
    errors: Tensor | None = None
    """w_s and w_v in each step of `ERROR_STEP`, standard normal, shape (B, S, 2), B = 1 if all have the same; None
    without errors."""
    glances: Glances | None = None
    """When the eyes are off the road; None if they never are."""
    recordable: ClassVar[bool] = True
    """Whether its operations may be recorded: nothing about it changes."""

    @property
    def delay(self) -> int:
        """Reaction time in ticks."""
        return round(self.model.reaction_time / self.world.clock.dt)

    @property
    def error_ticks(self) -> int:
        """Ticks for which errors are held."""
        return max(1, round(ERROR_STEP / self.world.clock.dt))

    @property
    def draws(self) -> tuple[int, int]:
        """Numbers of standard normal draws of an episode: for errors of estimation, and for glances."""
        clock, model = self.world.clock, self.model
        errors = 2 * math.ceil(clock.ticks / self.error_ticks) if model.gap_error or model.approach_error else 0
        return errors, count_glance_draws(clock.dt * clock.ticks) if model.glances else 0

    @property
    def noise_columns(self) -> int:
        """Number of columns of x that are its noise, the last ones."""
        return sum(self.draws) if self.world.noise is True else 0

    def with_draws(self, draws: Tensor) -> HumanDriver:
        """Return the drivers of B episodes with standard normal draws, shape (B, sum of `draws`)."""
        errors, glances = draws[:, : self.draws[0]], draws[:, self.draws[0] :]
        dt = self.error_ticks * self.world.clock.dt
        steps = list(errors.reshape(len(draws), -1, 2).unbind(dim=1))
        for step in range(1, len(steps)):
            steps[step] = step_errors(steps[step - 1], steps[step], dt, self.model.error_correlation)
        return replace(
            self,
            errors=torch.stack(steps, dim=1) if steps else None,
            glances=draw_glances(glances) if self.model.glances else None,
        )

    def to(self, device: torch.device) -> HumanDriver:
        """Return the driver with its noise on a device."""
        errors = None if self.errors is None else self.errors.to(device)
        glances = None if self.glances is None else Glances(*(part.to(device) for part in self.glances))
        return replace(self, errors=errors, glances=glances)

    def act(self, episode: Episode, memory: Any) -> tuple[Tensor, Any]:
        """Decide by what was seen a reaction time ago, or last; see `Driver`."""
        state, model, dt = episode.state, self.model, self.world.clock.dt
        memory = self._begin(episode) if memory is None else memory
        near = in_wandering_zone(state, episode.road, model.wandering)
        since = torch.where(near, memory.since + 1, -1)
        seen = look(state, since >= round(model.noticing_time / dt))
        past = (*memory.past, (seen, state.speed[:, 0], memory.acceleration))[-self.delay - 1 :]
        late, speed, acceleration = past[0]
        due, away = self._look_away(memory, late, speed)
        known = self._carry_forward(memory, late, away)
        errors = speed.new_zeros(1, 2) if self.errors is None else self.errors[:, memory.tick // self.error_ticks]
        lead = estimate_leads(known, speed, errors, model)
        lead, expected = anticipate(lead, speed, acceleration, min(memory.tick, self.delay) * dt)
        wanted = respond(lead, expected, model)
        actual = torch.maximum(wanted, memory.acceleration.clamp(max=0.0) - model.jerk * dt)
        steering = lane_keeping(state.y[:, 0], state.heading[:, 0], state.speed[:, 0], episode.road)
        later = _HumanMemory(memory.tick + 1, since, past, due, away, known, speed, actual)
        return torch.stack((actual, steering), dim=1), later

    def _begin(self, episode: Episode) -> _HumanMemory:
        """Return the memory at time 0: the driver knows the vehicles of its lane, which have kept their speeds."""
        if self.noise_columns and self.errors is None and self.glances is None:
            raise ValueError("Expected the draws of its noise: call with_draws first.")
        state, road = episode.state, episode.road
        in_lane = in_wandering_zone(state, road, road.width / 2)
        nothing = torch.zeros_like(state.speed[:, 0])
        since = torch.where(in_lane, _ALWAYS, -1)
        none, on_road = torch.zeros_like(since[:, 0]), torch.zeros_like(episode.collided)
        return _HumanMemory(0, since, (), none, on_road, look(state, in_lane), nothing, nothing)

    def _look_away(self, memory: _HumanMemory, late: Percept, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Return the number of the glance due, and whether the eyes are off the road; none begins in danger."""
        if self.glances is None:
            return memory.glance, memory.away
        time = max(0, memory.tick - self.delay) * self.world.clock.dt
        due = (self.glances.start <= time).sum(dim=1)  # how many have begun
        begun = torch.where(due == memory.glance, memory.away, inverse_tau(late, speed) <= MOST_URGENT_GLANCE)
        return due, begun & self.glances.off_road(time)

    def _carry_forward(self, memory: _HumanMemory, late: Percept, away: Tensor) -> Percept:
        """Return what is known of a reaction time ago: seen then, or by the last look if speeds were kept."""
        moved = self.world.clock.dt if memory.tick > self.delay else 0.0
        distance = memory.known.distance + moved * (memory.known.speed - memory.late_speed[:, None])
        held = memory.known._replace(distance=distance)
        return Percept(*(torch.where(away[:, None], old, new) for old, new in zip(held, late, strict=True)))
