"""`noisy:EGO`: an ego behind the imperfections of a full driving stack.

Any ego gets errors of localisation and perception, vehicles that it does not detect, latency, a planner that plans less
often than the world ticks, and actuators with lag and limited rates. All randomness is standard normal draws, which a
`DrivingProblem` makes part of x: f stays a function of x, and the failures that a sampler finds replay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from statistics import NormalDist
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rare_envs.control.idm import check_numbers
from rare_envs.devices import constant, fixed_draws, move_to
from rare_envs.egos.policy import as_driver
from rare_envs.sensors.lidar import perceive_traffic
from rare_envs.simulation.cuda_graphs import says_recordable
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import Driver, World, noise_columns
from rare_envs.traffic.bodies import lead_of
from rare_envs.traffic.state import State

OWN_ERRORS, ERRORS_PER_VEHICLE = 3, 4
"""Numbers of errors: of the ego (across, heading, speed), of each other vehicle (along, across, speed, missed)."""
OUT_OF_SIGHT = 400.0
"""Distance ahead at which a missed vehicle is placed [m]: beyond the range of every sensor."""
FIXED_STACK_SEED = 54321
"""Seed of the one sequence of draws of `noise="fixed"`; any number would do."""


@dataclass(frozen=True)
class Stack:
    """Size of a stack's imperfections: of errors, which are normal, the standard deviation.

    They stand between the world and the driver as Piazzoni et al. propose (2020, "Modeling perception errors towards
    robust decision making in autonomous vehicles", IJCAI). The defaults are our choice, round numbers for an ordinary
    stack on an ordinary road, and no measurement; docs/egos.md has published figures.
    """

    across: float = 0.1
    """Localisation across the road [m]."""
    heading: float = 0.002
    """Localisation, heading [rad]."""
    own_speed: float = 0.1
    """Own speed [m/s]."""
    position: float = 0.3
    """Of other vehicles, along and across [m]."""
    speed: float = 0.5
    """Of other vehicles [m/s]."""
    missed: float = 0.01
    """Probability that a vehicle is not detected at a moment."""
    correlation: float = 0.5
    """Correlation time of all errors and misses [s]: exp(-t / `correlation`)."""
    latency: float = 0.2
    """From the observation of other vehicles to the decision [s]; own position and speed are known without."""
    period: float = 0.2
    """Between two plans of the speed [s]; steering follows the path at every tick."""
    lag: float = 0.3
    """Time constant of acceleration [s]."""
    steering_lag: float = 0.1
    """Time constant of steering [s]."""
    jerk: float = 10.0
    """Largest change of acceleration [m/s^3]."""
    steering_rate: float = 0.4
    """Largest change of the steering angle [rad/s]."""

    def __post_init__(self) -> None:
        check_numbers(self, "stack", {"of at least 0, finite": [each.name for each in fields(self)]})
        if not self.missed < 1.0 or not (self.jerk and self.steering_rate):
            got = f"{self.missed:g}, {self.jerk:g} and {self.steering_rate:g}"
            raise ValueError(f"Expected missed below 1, and jerk and steering_rate above 0, got {got}.")

    def every(self, world: World) -> int:
        """Return the number of ticks from plan to plan."""
        return max(1, round(self.period / world.clock.dt))

    def noise_shape(self, world: World) -> tuple[int, int]:
        """Return the shape of an episode's standard normal draws: plans, and errors K of the ego and the others."""
        plans = math.ceil(world.clock.ticks / self.every(world))
        return plans, OWN_ERRORS + ERRORS_PER_VEHICLE * (world.scenario.vehicles - 1)

    def noise_columns(self, world: World) -> int:
        """Return how many standard normal columns of x, the last ones, are its noise in a world."""
        return math.prod(self.noise_shape(world)) if world.noise is True else 0


@dataclass(frozen=True)
class NoisyEgo:
    """An ego behind a stack; a `DrivingProblem` turns it into a driver of its world."""

    ego: Any
    """Whatever `rare_envs.DrivingProblem` takes."""
    stack: Stack = field(default_factory=Stack)
    """Its imperfections."""

    @property
    def observation_space(self) -> Any:
        """Space of the ego behind the stack, None if it has none."""
        # the ego is the user's: it need not declare anything
        return getattr(self.ego, "observation_space", None)

    @property
    def deterministic(self) -> bool | None:
        """Whether the ego behind the stack says that its answers repeat; the stack's own noise does, by x."""
        return getattr(self.ego, "deterministic", None)  # likewise

    def noise_columns(self, world: World) -> int:
        """Return how many standard normal columns of x are the stack's noise in a world."""
        return self.stack.noise_columns(world)

    def in_world(self, world: World) -> NoisyDriver:
        """Return the driver that it is in a world."""
        if world.clock.action != "continuous":
            raise ValueError(f'Expected action="continuous" for an ego behind a stack, got {world.clock.action!r}.')
        driver = as_driver(self.ego, world)
        if noise_columns(driver):
            raise ValueError(
                f"Expected an ego without noise of its own behind a stack, got {type(driver).__name__} with "
                "some: give one that acts by its means, or leave noisy: out."
            )
        return NoisyDriver(driver, self.stack, world)


class _StackMemory(NamedTuple):
    """State of a stack between two ticks."""

    tick: int
    """Of the next action."""
    past: tuple[State, ...]
    """True states up to the latency ago, the oldest first."""
    errors: Tensor
    """Standard normal, shape (B, K)."""
    inner: Any
    """Memory of the driver behind the stack."""
    planned: Tensor
    """Acceleration of the last plan and steering, shape (B, 2)."""
    actuated: Tensor
    """Present acceleration and steering of the actuators, shape (B, 2)."""


@dataclass(frozen=True)
class NoisyDriver:
    """A driver behind a stack, in a world."""

    inner: Driver
    stack: Stack
    world: World
    draws: Tensor | None = None
    """Standard normal, shape (B, plans, K); None for what the world's noise says without columns of x."""

    @property
    def noise_columns(self) -> int:
        """Number of columns of x that are its noise."""
        return self.stack.noise_columns(self.world)

    @property
    def recordable(self) -> bool:
        """Whether its operations may be recorded: as of the driver behind the stack."""
        return says_recordable(self.inner)

    def to(self, device: torch.device) -> NoisyDriver:
        """Return the driver with what is behind the stack on a device."""
        return replace(self, inner=move_to(device, self.inner))

    def with_draws(self, draws: Tensor) -> NoisyDriver:
        """Return the driver of B episodes with standard normal draws, shape (B, `noise_columns`)."""
        return replace(self, draws=draws.reshape(-1, *self.stack.noise_shape(self.world)))

    def act(self, episode: Episode, memory: Any) -> tuple[Tensor, Any]:
        """Decide by delayed and erroneous perception, at the plan's rate, through lagging actuators; see `Driver`."""
        state, stack = episode.state, self.stack
        if memory is None:
            nothing = state.x.new_zeros(len(state.x), 2)
            errors = state.x.new_zeros(len(state.x), stack.noise_shape(self.world)[1])
            memory = _StackMemory(0, (), errors, None, nothing, nothing)
        back = round(stack.latency / self.world.clock.dt)
        past = (*memory.past, state)[-back - 1 :]
        plan, later = divmod(memory.tick, stack.every(self.world))
        errors = memory.errors if later else self._step_errors(memory.errors, plan)
        seen = self._perceive(state, past[0], errors)
        perception = None if episode.perception is None else perceive_traffic(seen, episode.road)
        shown = episode._replace(state=seen, lead=lead_of(seen, episode.road), perception=perception)
        planned, inner = self.inner.act(shown, memory.inner)
        if later:  # the speed keeps the last plan, the path is followed at every tick
            planned = torch.stack((memory.planned[:, 0], planned[:, 1]), dim=1)
        actuated = self._actuate(memory.actuated, planned)
        return actuated, _StackMemory(memory.tick + 1, past, errors, inner, planned, actuated)

    def _step_errors(self, errors: Tensor, plan: int) -> Tensor:
        """Return the errors at a plan from those at the plan before: autoregressions of order 1 with variance 1."""
        world, tau = self.world, self.stack.correlation
        if world.noise is False:
            return errors
        if self.draws is not None:
            fresh = self.draws[:, min(plan, self.draws.shape[1] - 1)]
        elif world.noise == "fixed":
            fresh = fixed_draws(self.stack.noise_shape(world), FIXED_STACK_SEED, errors)[plan].expand_as(errors)
        else:
            raise ValueError("Expected the draws of its noise: call with_draws first.")
        if plan == 0:
            return fresh
        correlation = math.exp(-self.stack.every(world) * world.clock.dt / tau) if tau else 0.0
        return correlation * errors + math.sqrt(1.0 - correlation * correlation) * fresh

    def _perceive(self, now: State, late: State, errors: Tensor) -> State:
        """Return the traffic with errors, standard normal (B, K): the ego as of now, the others as of late."""
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

    def _actuate(self, before: Tensor, planned: Tensor) -> Tensor:
        """Return the actuators' output (B, 2) after a tick: first-order lags with limited rates."""
        stack, dt = self.stack, self.world.clock.dt
        shares = tuple(1.0 - math.exp(-dt / lag) if lag else 1.0 for lag in (stack.lag, stack.steering_lag))
        most = constant((stack.jerk * dt, stack.steering_rate * dt), before)
        change = (planned - before) * constant(shares, before)
        return before + torch.maximum(torch.minimum(change, most), -most)
