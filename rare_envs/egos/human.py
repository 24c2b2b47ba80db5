"""The ego "human": an attentive human driver, whose errors, glances and readiness to steer are noise columns of x."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, Final, NamedTuple

import torch
from torch import Tensor

from rare_envs.control.human_driver import (
    NOBODY,
    Ahead,
    Glances,
    HumanDriverModel,
    anticipate,
    count_glance_draws,
    draw_glances,
    estimate,
    evasive_steps,
    expansion_rate,
    find_ahead,
    respond,
    seen_expansion_rate,
    steer_along,
    step_errors,
)
from rare_envs.control.idm import lane_keeping
from rare_envs.devices import constant, may_hold
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import World
from rare_envs.traffic.state import NEAR_ZERO, VEHICLE_LENGTH, VEHICLE_WIDTH

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


HUMAN_EGOS: Final[Mapping[str, HumanEgo]] = MappingProxyType(
    {"human": HumanEgo(), "human:no-headway-rule": HumanEgo(HumanDriverModel(headway_rule=False))}
)
"""The human drivers by name, to be printed together: with and without the rule that a glance is no longer than the
headway, of which no more is known than a simulator study tells. They do not bracket people: looming breaks glances off
in both, and both crash because of glances less often."""


class _Glance(NamedTuple):
    """Glance of B drivers that is due; (B,) each."""

    number: Tensor
    """int64."""
    away: Tensor
    """Whether the eyes are off the road, boolean."""
    until: Tensor
    """When it ends by the headway rule [s]."""


class _Sight(NamedTuple):
    """What there was to see for B drivers at a moment; (B,) each."""

    ahead: Ahead
    on_left: Tensor
    """Whether a vehicle comes in beside or just ahead from the left, boolean, ..."""
    on_right: Tensor
    """... from the right."""
    speed: Tensor
    """Own speed [m/s]."""
    acceleration: Tensor
    """Own acceleration over the last tick [m/s^2]: felt, so weak brakes are felt too."""


class _HumanMemory(NamedTuple):
    """Memory of B drivers between two ticks; V other vehicles."""

    tick: int
    """Of the next action."""
    zone: Tensor
    """Distance from the middle of the lane within which each vehicle may be noticed [m], (B, V)."""
    beside: Tensor
    """Which vehicles began outside of the driver's lane, boolean, (B, V)."""
    since: Tensor
    """Ticks for which each vehicle has been in its zone, -1 outside of it, int64, (B, V)."""
    speeds: Tensor
    """Of the others a tick ago [m/s], (B, V)."""
    past: tuple[_Sight, ...]
    """Up to the reaction time ago, the oldest first."""
    glance: _Glance
    known: Ahead
    """What was seen last, carried forward at constant speeds while the eyes were off the road."""
    evasion: Tensor
    """Tick of the evasive manoeuvre, int64, (B,): 0 for none, negative to the left, positive to the right."""


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
    evades: Tensor | None = None
    """Who steers away from a vehicle that comes in beside them, boolean, shape (B,); None if nobody does."""
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
    def draws(self) -> tuple[int, int, int]:
        """Numbers of standard normal draws of an episode: for errors of estimation, for glances, for evasion."""
        clock, model = self.world.clock, self.model
        errors = 2 * math.ceil(clock.ticks / self.error_ticks) if model.gap_error or model.approach_error else 0
        glances = count_glance_draws(clock.dt * clock.ticks) if model.glances else 0
        return errors, glances, int(model.evasive_share > 0.0)

    @cached_property
    def evasion(self) -> tuple[float, ...]:
        """Ways across in the ticks of the way out of the evasive manoeuvre [m]: the body stays inside the own lane."""
        model, room = self.model, (self.world.scenario.road.width - VEHICLE_WIDTH) / 2
        return evasive_steps(min(model.evasive_distance, room), model.evasive_acceleration, self.world.clock.dt)

    @property
    def noise_columns(self) -> int:
        """Number of columns of x that are its noise, the last ones."""
        return sum(self.draws) if self.world.noise is True else 0

    def with_draws(self, draws: Tensor) -> HumanDriver:
        """Return the drivers of B episodes with standard normal draws, shape (B, sum of `draws`)."""
        errors, glances, evasion = torch.split(draws, list(self.draws), dim=1)
        dt = self.error_ticks * self.world.clock.dt
        steps = list(errors.reshape(len(draws), errors.shape[1] // 2, 2).unbind(dim=1))
        for step in range(1, len(steps)):
            steps[step] = step_errors(steps[step - 1], steps[step], dt, self.model.error_correlation)
        return replace(
            self,
            errors=torch.stack(steps, dim=1) if steps else None,
            glances=draw_glances(glances) if self.model.glances else None,
            evades=torch.special.ndtr(evasion[:, 0]) < self.model.evasive_share if evasion.shape[1] else None,
        )

    def to(self, device: torch.device) -> HumanDriver:
        """Return the driver with its noise on a device."""
        errors = None if self.errors is None else self.errors.to(device)
        glances = None if self.glances is None else Glances(*(part.to(device) for part in self.glances))
        evades = None if self.evades is None else self.evades.to(device)
        return replace(self, errors=errors, glances=glances, evades=evades)

    def act(self, episode: Episode, memory: Any) -> tuple[Tensor, Any]:
        """Decide by what was seen a reaction time ago, or last; see `Driver`."""
        model, dt = self.model, self.world.clock.dt
        memory = self._begin(episode) if memory is None else memory
        seen, since = self._look(episode, memory)
        tick, acceleration = memory.tick, seen.acceleration
        past = (*memory.past, seen)[-self.delay - 1 :]
        late = past[0]
        glance = self._look_away(memory, late)
        known = self._carry_forward(memory, late, glance.away)
        errors = acceleration.new_zeros(1, 2) if self.errors is None else self.errors[:, tick // self.error_ticks]
        lead = estimate(known, late.speed, errors, model)
        lead, speed = anticipate(lead, late.speed, late.acceleration, min(tick, self.delay) * dt)
        wanted = respond(lead, known.acceleration, speed, model)
        actual = torch.maximum(wanted, acceleration.clamp(max=0.0) - model.jerk * dt)
        steering, evasion = self._steer(episode, memory.evasion, late, glance.away)
        last = (episode.state.speed[:, 1:], past, glance, known, evasion)
        return torch.stack((actual, steering), dim=1), _HumanMemory(tick + 1, memory.zone, memory.beside, since, *last)

    def _begin(self, episode: Episode) -> _HumanMemory:
        """Return the memory at time 0: the driver knows the vehicles of its lane; speeds have been kept until then."""
        if self.noise_columns and self.errors is None and self.glances is None and self.evades is None:
            raise ValueError("Expected the draws of its noise: call with_draws first.")
        state, width = episode.state, episode.road.width
        offset = (state.y[:, 1:] - episode.road.centre_of(state.y[:, :1])).abs()
        beside, next_lane = offset > width / 2, (offset > width) & (offset < 1.5 * width)
        zone = torch.where(next_lane, offset, width) - self.model.wandering
        nothing = torch.zeros_like(state.speed[:, 0])
        since, none = torch.where(beside, -1, _ALWAYS), torch.zeros_like(nothing, dtype=torch.int64)
        glance = _Glance(none, torch.zeros_like(episode.collided), torch.full_like(nothing, torch.inf))
        nobody = Ahead(torch.full_like(nothing, NOBODY), nothing, nothing)
        return _HumanMemory(0, zone, beside, since, state.speed[:, 1:], (), glance, nobody, none)

    def _look(self, episode: Episode, memory: _HumanMemory) -> tuple[_Sight, Tensor]:
        """Return what there is to see, and for how many ticks each vehicle has been in its zone (B, V)."""
        state, model, dt = episode.state, self.model, self.world.clock.dt
        lateral = state.y[:, 1:] - episode.road.centre_of(state.y[:, :1])
        offset = lateral.abs()
        since = torch.where(offset <= memory.zone, memory.since + 1, -1)
        noticed = since >= round(model.noticing_time / dt)
        signals = self.world.find_signals(episode) if model.notice_indicator else None
        noticed = noticed if signals is None else noticed | signals
        ahead = find_ahead(state, noticed, memory.speeds, dt)
        on_left = on_right = torch.zeros_like(episode.collided)
        near = noticed & memory.beside & (offset < VEHICLE_WIDTH + model.evasive_clearance)
        if self.evades is not None and may_hold(near):
            near = near & ((state.x[:, 1:] - state.x[:, :1]).abs() < VEHICLE_LENGTH + model.evasive_reach)
            on_left, on_right = (near & (lateral < 0.0)).any(dim=1), (near & (lateral >= 0.0)).any(dim=1)
        speed = state.speed[:, 0]
        felt = (speed - memory.past[-1].speed) / dt if memory.past else torch.zeros_like(speed)
        return _Sight(ahead, on_left, on_right, speed, felt), since

    def _look_away(self, memory: _HumanMemory, late: _Sight) -> _Glance:
        """Return the glance that is due: one is begun if nothing comes nearer, and looming ends it.

        Of what there is to see, whether the driver looks or not: it is seen from the corner of the eye.
        """
        if self.glances is None:
            return memory.glance
        model, (number, away, until), gap = self.model, memory.glance, late.ahead.gap
        time = max(0, memory.tick - self.delay) * self.world.clock.dt
        due = (self.glances.start <= time).sum(dim=1)  # how many have begun, one at least: the first starts at 0
        goes_on, closing = due == number, late.speed - late.ahead.speed
        looming = expansion_rate(gap, closing)
        calm = (closing * model.glance_ttc <= gap.clamp_min(NEAR_ZERO)) & (looming <= model.glance_looming)
        away = torch.where(goes_on, away, calm) & (time < self.glances.end.gather(1, due[:, None] - 1)[:, 0])
        away = away & (looming < seen_expansion_rate(gap, model.glance_eccentricity))
        if model.headway_rule:
            longest = gap / late.speed.clamp_min(NEAR_ZERO) - model.reaction_time
            until = torch.where(goes_on, until, longest + time)
            away = away & (until > time)
        return _Glance(due, away, until)

    def _carry_forward(self, memory: _HumanMemory, late: _Sight, away: Tensor) -> Ahead:
        """Return what is known of a reaction time ago: seen then, or by the last look if speeds were kept."""
        if self.glances is None or memory.tick == 0:
            return late.ahead
        known, moved = memory.known, self.world.clock.dt if memory.tick > self.delay else 0.0
        held = known._replace(gap=known.gap + (known.speed - memory.past[0].speed) * moved)
        return Ahead(*(torch.where(away, old, new) for old, new in zip(held, late.ahead, strict=True)))

    def _steer(self, episode: Episode, evasion: Tensor, late: _Sight, away: Tensor) -> tuple[Tensor, Tensor]:
        """Return steering angles (B,), along the lane or through the evasive manoeuvre, and the tick of that.

        Drivers who look begin it where vehicles come in on one side only, to the other: their own lane is free there.
        They turn back to its middle once nobody is beside or just ahead any more, and may begin it again then.
        """
        _, y, heading, speed = episode.state.vehicles[0]
        keeping = lane_keeping(y, heading, speed, episode.road)
        if self.evades is None or not self.evasion:
            return keeping, evasion
        near, lasting = late.on_left | late.on_right, len(self.evasion)
        if not may_hold(near | (evasion != 0)):
            return keeping, evasion
        begin = (late.on_left.long() - late.on_right.long()) * (self.evades & ~away)
        step = torch.where(evasion == 0, begin, evasion.sign())
        evasion = evasion + step.masked_fill(near & (evasion.abs() == lasting + 1), 0)
        evasion = evasion.masked_fill(evasion.abs() > 2 * lasting + 1, 0)
        out, back = self.evasion, tuple(-way for way in self.evasion)
        table = (*out[::-1], 0.0, *back[::-1], 0.0, *out, 0.0, *back)  # of ticks from -1 - 2 lasting on
        way = constant(table, y)[evasion + (2 * lasting + 1)]
        moving = steer_along(way, heading, speed, self.world.clock.dt)
        return torch.where(evasion == 0, keeping, moving), evasion
