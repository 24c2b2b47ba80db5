"""`noisy:EGO`: an ego behind the imperfections of a full stack, the stand-in for one such as Apollo.

A stack does not see the world as it is, nor at once, nor does the car do at once what it decides. Here any ego gets
errors of localisation and perception, vehicles it misses, latency, a planner that plans less often than the world
ticks, and actuators with lag and limited rates. All of its randomness is standard normal draws, which a
`DrivingProblem` makes part of x: f stays a function of x, and what a sampler finds replays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from statistics import NormalDist
from typing import Any, NamedTuple
from urllib.parse import parse_qsl

import torch
from torch import Tensor

from rare_envs.egos.policy import as_driver
from rare_envs.plugins import did_you_mean
from rare_envs.sensors.perception import perceive_traffic
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.rollout import Driver
from rare_envs.simulation.world import World
from rare_envs.traffic.lead import lead_of
from rare_envs.traffic.state import State

OWN_ERRORS, ERRORS_PER_VEHICLE = 3, 4
"""Errors of the ego itself (across, heading, speed), and of each other vehicle (along, across, speed, missed)."""
OUT_OF_SIGHT = 400.0
"""Where a missed vehicle is put [m ahead]: farther than any ego looks."""


@dataclass(frozen=True)
class Stack:
    """How imperfect a stack is.

    Errors are normal, with the correlation exp(-t / `correlation`) in time. That errors of perception are put between
    the world and the driver is what Piazzoni et al. propose (2020, "Modeling perception errors towards robust decision
    making in autonomous vehicles", IJCAI). The defaults are our choice, round numbers for an ordinary stack on an
    ordinary road; none is a measurement of one stack, so give those of yours. Where a published figure is known to us
    it stands beside the default.

    Raises:
        ValueError: If a number is negative or a probability is not below 1.
    """

    across: float = 0.1
    """Localisation across the road, standard deviation [m]. Wan et al. (2018, "Robust and precise vehicle localization
    based on multi-sensor fusion in diverse city scenes", ICRA, abstract) report 0.05 to 0.1 m, of position."""
    heading: float = 0.002
    """Localisation, heading [rad]; our choice."""
    own_speed: float = 0.1
    """Own speed [m/s]; our choice."""
    position: float = 0.3
    """Of other vehicles, along and across [m]; our choice."""
    speed: float = 0.5
    """Of other vehicles [m/s]; our choice."""
    missed: float = 0.01
    """Probability that a vehicle is not detected at a moment; our choice."""
    correlation: float = 0.5
    """Correlation time of all errors and misses [s]; our choice."""
    latency: float = 0.2
    """From what is sensed of others to what is decided [s]; our choice. Lin et al. (2018, "The architectural
    implications of autonomous driving", ASPLOS) design for about 0.1 s; the cruise controls of five cars on sale
    responded after 1.7 to 2.5 s (doi:10.1177/0361198120911047, abstract), lags included. Its own position and speed a
    stack has at once here."""
    period: float = 0.2
    """Between two plans of the speed [s], our choice; steering follows the path at every tick."""
    lag: float = 0.3
    """Time constant of acceleration [s]; our choice. Autoware's planning simulator has 0.1 s, and 0.1 s of delay."""
    steering_lag: float = 0.1
    """Time constant of steering [s]; our choice. Autoware's planning simulator has 0.27 s, and 0.24 s of delay."""
    jerk: float = 10.0
    """Largest change of acceleration [m/s^3]; our choice."""
    steering_rate: float = 0.4
    """Largest change of the steering angle [rad/s]; our choice."""

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if not (isinstance(value, int | float) and 0.0 <= value < math.inf):
                raise ValueError(f"Expected {each.name} to be a number of at least 0, got {value!r}.")
        if not self.missed < 1.0 or not (self.jerk and self.steering_rate):
            raise ValueError("Expected missed below 1, and jerk and steering_rate above 0.")

    @classmethod
    def read(cls, query: str) -> Stack:
        """Settings as in "latency=0.3&missed=0.05"."""
        known = [each.name for each in fields(cls)]
        given = {}
        for name, value in parse_qsl(query, keep_blank_values=True):
            if name not in known:
                raise ValueError(f"Unknown setting {name!r}{did_you_mean(name, known)}; expected {', '.join(known)}.")
            try:
                given[name] = float(value)
            except ValueError as error:
                raise ValueError(f"Expected {name} to be a number, got {value!r}.") from error
        return cls(**given)


def ticks_per_plan(stack: Stack, world: World) -> int:
    """Return the number of ticks from plan to plan."""
    return max(1, round(stack.period / world.clock.dt))


def noise_shape(stack: Stack, world: World) -> tuple[int, int]:
    """Return the shape of an episode's standard normal draws: plans, and errors K of the ego and the other vehicles."""
    plans = math.ceil(world.clock.ticks / ticks_per_plan(stack, world))
    return plans, OWN_ERRORS + ERRORS_PER_VEHICLE * (world.scenario.vehicles - 1)


@dataclass(frozen=True)
class NoisyEgo:
    """An ego behind a stack; a `DrivingProblem` turns it into a driver of its world."""

    ego: Any
    stack: Stack = field(default_factory=Stack)

    @property
    def observation_space(self) -> Any:
        """That of the ego behind it, None if it has none."""
        return getattr(self.ego, "observation_space", None)

    @property
    def deterministic(self) -> bool | None:
        """Whether the ego behind the stack says that its answers repeat; the stack's own noise does, by x."""
        return getattr(self.ego, "deterministic", None)

    def noise_columns(self, world: World) -> int:
        """Return how many standard normal columns of x are the stack's noise in a world."""
        return math.prod(noise_shape(self.stack, world)) if world.noise is True else 0

    def in_world(self, world: World) -> NoisyDriver:
        """Return the driver that it is in a world.

        Raises:
            ValueError: The ego does not fit the world, or decides meta-actions.
        """
        if world.clock.action != "continuous":
            raise ValueError(f'Expected action="continuous" for an ego behind a stack, got {world.clock.action!r}.')
        return NoisyDriver(as_driver(self.ego, world), self.stack, world)


class _StackMemory(NamedTuple):
    tick: int
    past: tuple[State, ...]
    """What was, up to the latency ago, the oldest first."""
    errors: Tensor
    """Standard normal, shape (B, K)."""
    inner: Any
    wanted: Tensor
    """Acceleration of the last plan and steering, shape (B, 2)."""
    done: Tensor
    """What the actuators do, shape (B, 2)."""


@dataclass(frozen=True)
class NoisyDriver:
    """A driver behind a stack, in a world."""

    inner: Driver
    stack: Stack
    world: World
    draws: Tensor | None = None
    """Standard normal, shape (B, plans, K); None for what the world's noise says without columns of x."""

    @property
    def every(self) -> int:
        """Ticks from plan to plan."""
        return ticks_per_plan(self.stack, self.world)

    @property
    def shape(self) -> tuple[int, int]:
        """Of an episode's draws: plans and K."""
        return noise_shape(self.stack, self.world)

    @property
    def noise_columns(self) -> int:
        """How many columns of x are its noise, the last ones."""
        return math.prod(self.shape) if self.world.noise is True else 0

    def with_draws(self, draws: Tensor) -> NoisyDriver:
        """Return the driver of B episodes with standard normal draws, shape (B, `noise_columns`)."""
        return replace(self, draws=draws.reshape(-1, *self.shape))

    def act(self, episode: Episode, memory: Any) -> tuple[Tensor, Any]:
        """See late and wrongly, plan now and then, and do it with a lag; see `rare_envs.simulation.rollout.Driver`."""
        state = episode.state
        if memory is None:
            nothing = state.x.new_zeros(len(state.x), 2)
            memory = _StackMemory(0, (), state.x.new_zeros(len(state.x), self.shape[1]), None, nothing, nothing)
        back = round(self.stack.latency / self.world.clock.dt)
        past = (*memory.past, state)[-back - 1 :]
        plans = memory.tick % self.every == 0
        errors = self._later(memory.errors, memory.tick // self.every) if plans else memory.errors
        seen = self._seen(state, past[0], errors)
        perception = None if episode.perception is None else perceive_traffic(seen, episode.road)
        shown = episode._replace(state=seen, lead=lead_of(seen, episode.road), perception=perception)
        wanted, inner = self.inner.act(shown, memory.inner)
        if not plans:  # the speed is planned now and then, the path is followed at every tick
            wanted = torch.stack((memory.wanted[:, 0], wanted[:, 1]), dim=1)
        done = self._done(memory.done, wanted)
        return done, _StackMemory(memory.tick + 1, past, errors, inner, wanted, done)

    def _later(self, errors: Tensor, plan: int) -> Tensor:
        """Errors at a plan from those at the plan before: autoregressions with variance 1."""
        if self.world.noise is False:
            return errors
        if self.draws is not None:
            fresh = self.draws[:, min(plan, self.draws.shape[1] - 1)]
        elif self.world.noise == "fixed":
            fresh = _fixed_draws(self.shape)[plan].to(errors).expand_as(errors)
        else:
            raise ValueError("Expected the draws of its noise; begin with with_draws.")
        if plan == 0:
            return fresh
        tau = self.stack.correlation
        kept = math.exp(-self.every * self.world.clock.dt / tau) if tau else 0.0
        return kept * errors + math.sqrt(1.0 - kept * kept) * fresh

    def _seen(self, now: State, late: State, errors: Tensor) -> State:
        """The traffic as the stack has it: itself as of now, the others relative to itself as they were sensed."""
        stack, own = self.stack, errors[:, :OWN_ERRORS]
        of_others = errors[:, OWN_ERRORS:].reshape(len(errors), -1, ERRORS_PER_VEHICLE)
        along, across, speed, hidden = of_others.unbind(dim=-1)
        missed = torch.zeros_like(hidden, dtype=torch.bool)
        if stack.missed and self.world.noise is not False:
            missed = hidden < NormalDist().inv_cdf(stack.missed)
        apart = late.x[:, 1:] - late.x[:, :1] + stack.position * along
        x = now.x[:, :1] + torch.where(missed, OUT_OF_SIGHT, apart)
        mine = [now.y[:, :1] + stack.across * own[:, :1], now.heading[:, :1] + stack.heading * own[:, 1:2]]
        my_speed, others = now.speed[:, :1] + stack.own_speed * own[:, 2:], late.speed[:, 1:] + stack.speed * speed
        return now._replace(
            x=torch.cat((now.x[:, :1], x), dim=1),
            y=torch.cat((mine[0], late.y[:, 1:] + stack.position * across), dim=1),
            heading=torch.cat((mine[1], late.heading[:, 1:]), dim=1),
            speed=torch.cat((my_speed, others), dim=1).clamp(min=0.0),
        )

    def _done(self, before: Tensor, wanted: Tensor) -> Tensor:
        """What the actuators make of it within a tick: first-order lags with limited rates."""
        stack, dt = self.stack, self.world.clock.dt
        shares = [1.0 - math.exp(-dt / lag) if lag else 1.0 for lag in (stack.lag, stack.steering_lag)]
        most = before.new_tensor([stack.jerk * dt, stack.steering_rate * dt])
        change = (wanted - before) * before.new_tensor(shares)
        return before + torch.maximum(torch.minimum(change, most), -most)


def _fixed_draws(shape: tuple[int, int]) -> Tensor:
    """The one sequence of draws of `noise="fixed"`."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(54321), dtype=torch.float64)
