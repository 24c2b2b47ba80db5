"""World: a scenario, its traffic and its settings, as pure functions; and the one time loop."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol, cast

import torch
from gymnasium import spaces
from torch import Tensor

from rare_envs.control.actions import follow_meta_actions, initial_aim, space_of_actions
from rare_envs.control.idm import IDM
from rare_envs.devices import fixed_draws
from rare_envs.distributions.product import NoiseDistribution
from rare_envs.distributions.space import Distribution, Parameter
from rare_envs.measures import Moment
from rare_envs.measures.longitudinal import avoid_rapid
from rare_envs.plugins import as_errors
from rare_envs.scenarios.base import Others, Scenario, drive_points
from rare_envs.sensors.camera import WEATHER, CameraContext
from rare_envs.sensors.lidar import perceive_traffic
from rare_envs.simulation.background import (
    FIRST_DRAWS,
    FIXED_SEED,
    Background,
    BackgroundState,
    TrafficBackground,
    noise_size,
    query_background,
)
from rare_envs.simulation.episode import LEARNED_TICK, Episode, EpisodeStatistics
from rare_envs.simulation.observation import observation_space
from rare_envs.simulation.settings import Clock, Measurement, Sensing
from rare_envs.traffic.bodies import find_struck, find_touching, lead_of, overlaps
from rare_envs.traffic.road import Road, WorldPose
from rare_envs.traffic.state import State, bicycle

Block = tuple[tuple[Parameter, ...], Distribution]
"""Parameters of x that are drawn together, with their distribution."""


def noise_block(name: str, meaning: str, size: int) -> list[Block]:
    """Return one parameter of so many standard normal columns; none of 0 columns."""
    parameter = Parameter(name, "", -math.inf, math.inf, meaning, size)
    return [((parameter,), NoiseDistribution(size))] if size else []


class TrafficPolicy(NamedTuple):
    """A policy in the place of a vehicle around the ego, without a memory of its own."""

    vehicle: int
    driver: Any
    """A `PolicyDriver`."""
    name: str
    """Its file, or its class."""


@dataclass(frozen=True)
class World:
    """A scenario and everything around it. Nothing here changes, and nothing is random.

    Example:
        >>> import torch
        >>> from rare_envs.scenarios.car_following import CAR_FOLLOWING
        >>> world = World(CAR_FOLLOWING, clock=Clock(dt=0.1, horizon=1.0))
        >>> episode = world.start(torch.tensor([[20.0, 15.0, 30.0]]))  # ego and lead speed [m/s], gap [m]
        >>> episode = world.step(episode, torch.zeros(1, 2))  # neither accelerates nor steers
        >>> round(float(episode.f), 3)  # (30 m - 0.1 s x 5 m/s) / 5 m/s
        5.9

    Raises:
        ValueError: If the parts do not fit together, or the noise is unknown.
    """

    scenario: Scenario
    sensing: Sensing = field(default_factory=Sensing)
    background: Background | TrafficBackground | None = None
    """Drivers of the vehicles around the ego; None for the scenario's script."""
    measurement: Measurement = field(default_factory=Measurement)
    clock: Clock = field(default_factory=Clock)
    """Time; without a horizon, that of the scenario."""
    noise: bool | str = True
    """Noise of drivers and camera: True, part of x; "fixed", one sequence for all x; False, none."""
    policies: tuple[TrafficPolicy, ...] = ()
    """Policies that drive single vehicles of the traffic, as agents of `rare_envs.parallel_env` do."""
    rapid: bool = True
    """Whether the ego's actions may be rapid manoeuvres; if not, `avoid_rapid` limits them."""

    def __post_init__(self) -> None:
        if self.clock.horizon is None:
            object.__setattr__(self, "clock", replace(self.clock, horizon=self.scenario.horizon))
        if not (isinstance(self.noise, bool) or self.noise == "fixed"):
            raise ValueError(f"Expected noise True, False or 'fixed', got {self.noise!r}.")
        if self.background is not None and self.clock.dt != LEARNED_TICK:
            raise ValueError(
                f"Expected dt = {LEARNED_TICK} s, the tick that these drivers learned with, got {self.clock.dt!r}."
            )

    @cached_property
    def uses_lidar(self) -> bool:
        """Whether the lidar features of all vehicles are computed at every moment."""
        by_lidar = self.background is not None and not isinstance(self.background, TrafficBackground)
        return self.sensing.uses_lidar or by_lidar or self.measurement.episode_measure.sees

    @cached_property
    def blocks(self) -> dict[str, list[Block]]:
        """Parameters of x behind the scenario's own: weather, weights of drivers, noise of drivers, of the camera."""
        weights = None if self.background is None else self.background.weights
        noise = noise_size(self.clock.ticks, self.scenario.vehicles - 1) if self._noisy and self.noise is True else 0
        found: dict[str, list[Block]] = {"weather": [], "weights": []}
        if self.sensing.weather:
            found["weather"] = list(WEATHER[:-1] if self.noise is False else WEATHER)
        if weights is not None:
            own = Parameter("weights", "", -math.inf, math.inf, "of the drivers' last layer", weights.dim)
            found["weights"] = [((own,), weights)]
        found["noise"] = noise_block("noise", "of the drivers, tick by tick", noise)
        key = int(self.sensing.weather and self.noise is True)
        found["camera_noise"] = noise_block("camera_noise", "from which the noise of all pixels follows", key)
        return found

    @cached_property
    def columns(self) -> dict[str, int]:
        """Numbers of columns of x, in their order: those of the scenario, and of each of the `blocks`."""
        sizes = {name: sum(p.size for own, _ in blocks for p in own) for name, blocks in self.blocks.items()}
        return {"scenario": self.scenario.size, **sizes}

    @cached_property
    def dim(self) -> int:
        """Number of columns of x, without those of an ego's noise."""
        return sum(self.columns.values())

    @property
    def _noisy(self) -> bool:
        return self.background is not None and self.background.noisy and self.noise is not False

    @property
    def observation_space(self) -> spaces.Space[Any]:
        """Space of the ego's observations."""
        return observation_space(self.scenario.vehicles, self.sensing.observation, self.sensing.camera)

    @property
    def action_space(self) -> spaces.Space[Any]:
        """Space of the ego's actions."""
        return space_of_actions(self.clock.action)

    def with_statistics(self) -> World:
        """Return the world with statistics of its episodes kept; see `Episode.statistics`."""
        return replace(self, measurement=replace(self.measurement, statistics=True))

    def start(self, x: Tensor) -> Episode:
        """Begin B episodes.

        Args:
            x: Scenario parameters, weather, drivers' weights, drivers' noise and the key of the camera's noise side by
                side (`columns`), shape (B, d), within the physical box; dtype and device are kept.

        Returns:
            The episodes at time 0.
        """
        own, weather, weights, noise, key = torch.split(x, list(self.columns.values()), dim=1)
        state, background = self.scenario.initial(own), None
        if self.background is not None:
            batch, others = len(noise), self.scenario.vehicles - 1
            draws = noise.reshape(batch, noise.shape[1] // (2 * others) if self._noisy else 0, others, 2)
            if self._noisy and self.noise == "fixed":
                shape = (1, FIRST_DRAWS + self.clock.ticks, others, 2)
                draws = fixed_draws(shape, FIXED_SEED, noise).expand(batch, -1, -1, -1)
            background = BackgroundState.start(self.background, weights.contiguous(), draws)
        episode = self.start_from(state, self._look(state)[1], background, self.sensing.start_camera(weather, key))
        none = torch.zeros_like(state.x, dtype=torch.bool)
        return episode._replace(overridden=none, disabled=none) if self.policies else episode

    def start_from(
        self,
        state: State,
        perception: Tensor | None,
        background_state: BackgroundState | None = None,
        camera_context: CameraContext | None = None,
    ) -> Episode:
        """Begin B episodes of the vehicle in the ego's place from a state, with lidar features (B, N, 51) or None."""
        road, measure = self.scenario.road, self.measurement.episode_measure
        moment = self._moment(state, road, perception, None)
        measure_state = measure.start(moment, self.clock.ticks)
        statistics = None
        if self.measurement.statistics:
            statistics = EpisodeStatistics.start(moment, self._least_ttc(measure_state))
        return Episode(
            state=state,
            lead=moment.lead,
            measure_state=measure_state,
            collided=torch.zeros_like(state.x[:, 0], dtype=torch.bool),
            road=road,
            perception=perception,
            background_state=background_state,
            measure=measure,
            aim=initial_aim(state, road) if self.clock.action == "meta" else None,
            statistics=statistics,
            camera_context=camera_context,
        )

    def update(self, episode: Episode, state: State, perception: Tensor | None, hit: Tensor) -> Episode:
        """Return episodes a tick later: new state, lidar features and hits of the vehicle in the ego's place, (B,)."""
        moment = self._moment(state, episode.road, perception, episode.state, episode.overridden)
        collided = episode.collided | hit
        measure_state = episode.measure.update(episode.measure_state, moment, episode.collided, collided)
        statistics, camera_context = episode.statistics, episode.camera_context
        if statistics is not None:
            statistics = statistics.update(moment, episode.collided, collided, self._least_ttc(measure_state))
        return episode._replace(
            state=state,
            lead=moment.lead,
            measure_state=measure_state,
            collided=collided,
            perception=perception,
            statistics=statistics,
            camera_context=camera_context and camera_context._replace(tick=camera_context.tick + 1),
        )

    def decode_meta_actions(
        self, episode: Episode, action: Tensor, commanded: Tensor | None = None
    ) -> tuple[Episode, Tensor]:
        """Turn meta-actions (B,) into what the controllers do in this tick; other actions stay as they are.

        With `commanded` (B, N), of all vehicles (B, N): a decision, and `IDLE` in the ticks that follow it. Return the
        episodes with their new aims, and accelerations [m/s^2] and steering angles [rad] in a last axis of 2.
        """
        if episode.aim is None or action.is_floating_point():
            return episode, action
        aim, action = follow_meta_actions(episode.aim, action, commanded, episode.state, episode.road)
        return episode._replace(aim=aim), action

    def step(self, episode: Episode, action: Tensor, commanded: Tensor | None = None) -> Episode:
        """Move every vehicle by one tick: all decide on the old state, then all move.

        A collision (a vehicle's body overlaps the ego's, or the ego's centre leaves the road, which is walled) is
        remembered. An episode that is stepped on after it moves without meaning, but its f does not change.

        A commanded vehicle moves as the ego does, by the bicycle model. One that was commanded and no longer is goes
        on from where it is: with the world's drivers, or by IDM and lane keeping where there was a script, which
        knows its own path only.

        Args:
            episode: B episodes.
            action: Acceleration [m/s^2] and steering angle [rad] of the ego, shape (B, 2); with `commanded` of all
                vehicles, shape (B, N, 2). Meta-actions are decoded before, see `decode_meta_actions`.
            commanded: Which vehicles take their action, boolean, shape (B, N); the ego always does. None if the
                others keep their drivers.

        Returns:
            The episodes one tick later.
        """
        if self.policies:
            episode, action, commanded = command_policies(self.policies, episode, action)
        old, dt, road, background_state = episode.state, self.clock.dt, episode.road, episode.background_state
        ego, (acceleration, steering) = old.vehicles[0], (action if commanded is None else action[:, 0]).unbind(1)
        curvature = None if road.reference_line is None else road.curvature(ego.x)
        if not self.rapid:
            acceleration, steering = avoid_rapid(ego.speed, acceleration, steering)
        moved = bicycle(*ego, acceleration, steering, dt, curvature)
        driver_actions = None
        if self.background is None or background_state is None:
            others = self.scenario.others(old, dt)
        else:
            driver_actions, background_state = query_background(
                self.background, background_state, old, road, episode.perception, dt
            )
            others = self.scenario.driven(old, driver_actions, dt)
        overridden = episode.overridden
        if commanded is not None or overridden is not None:
            others, overridden = apply_overrides(episode, action, commanded, others, driver_actions, dt)
        rest = zip(*(field.unbind(1) for field in others[:4]), strict=True)
        theta: Tensor | None = getattr(others, "theta", None)  # a user's script may return any four fields
        state = State.of_vehicles((moved, *rest), old.theta if theta is None else theta)
        place, perception = self._look(state)
        hit = overlaps(state, road, "ego", place).any(dim=1) | road.off_road(state.vehicles[0].y)
        if self.measurement.collisions == "any":
            hit = hit | overlaps(state, road, "others").any(dim=1)
        if episode.disabled is not None and commanded is not None:
            struck = find_struck(find_touching(state, road), road.off_road(state.y), commanded)
            episode = episode._replace(disabled=episode.disabled | struck)
        episode = episode._replace(background_state=background_state, overridden=overridden)
        return self.update(episode, state, perception, hit)

    def find_signals(self, episode: Episode) -> Tensor | None:
        """Return whose indicator is on, as `Scenario.signals`, of those that nobody has commanded; None without any."""
        if self.scenario.signals is None:
            return None
        on = self.scenario.signals(episode.state)
        return on if episode.overridden is None else on & ~episode.overridden[:, 1:]

    def _moment(
        self,
        state: State,
        road: Road,
        perception: Tensor | None,
        before: State | None,
        overridden: Tensor | None = None,
    ) -> Moment:
        """Return the moment of a state, with others' evasions if the measure counts them and nobody commands them."""
        evades = self.scenario.evades if self.measurement.episode_measure.twice else None
        evading = None if evades is None else evades(state)
        if evading is not None and overridden is not None:
            evading = evading & ~overridden[:, 1:].any(dim=1)
        return Moment(state, lead_of(state, road), road, perception, before, self.clock.dt, evading)

    def _least_ttc(self, measure_state: Tensor) -> Tensor | None:
        """Return the least time to collision, where that is the measure."""
        return measure_state if self.measurement.measure == "ttc" else None

    def _look(self, state: State) -> tuple[WorldPose | None, Tensor | None]:
        """Return where the vehicles are in the flat world, and their lidar features; None in a world without lidar."""
        if not self.uses_lidar:
            return None, None
        place = self.scenario.road.place(state.x, state.y, state.heading)
        return place, perceive_traffic(state, self.scenario.road, place)


def roll_out(state: State, disabled: Tensor, action: Tensor) -> Tensor:
    """Return actions (B, N, 2), in place of those of crashed vehicles (B, N) what HighwayEnv's do: slow down ahead."""
    rolling = torch.stack((-state.speed, torch.zeros_like(state.speed)), dim=-1)
    return torch.where(disabled[..., None], rolling, action)


def command_policies(
    policies: Sequence[TrafficPolicy], episode: Episode, action: Tensor
) -> tuple[Episode, Tensor, Tensor]:
    """Return the actions (B, N, 2) of all vehicles, the ego's (B, 2) among them, and which are commanded, (B, N)."""
    state, memories = episode.state, dict(episode.memories or {})
    disabled = torch.zeros_like(state.x, dtype=torch.bool) if episode.disabled is None else episode.disabled
    actions, commanded = torch.zeros(*state.x.shape, 2).to(action), disabled.clone()
    actions[:, 0] = action
    for vehicle, driver, name in policies:
        seen = state.seen_by(vehicle)
        own = None if episode.perception is None else episode.perception[:, vehicle : vehicle + 1]
        view = episode._replace(
            state=seen, lead=lead_of(seen, episode.road), collided=disabled[:, vehicle], perception=own
        )
        actions[:, vehicle], memory = driver.act(view, memories.get(vehicle))
        if memory is not None and memory[0] is not None:
            raise ValueError(f"Expected a policy without a memory to drive traffic, got {name}, which has one.")
        memories[vehicle], commanded[:, vehicle] = memory, True
    return episode._replace(memories=memories), roll_out(state, disabled, actions), commanded


_RULE = IDM()


def apply_overrides(
    episode: Episode, action: Tensor, commanded: Tensor | None, others: Others, driven: Tensor | None, dt: float
) -> tuple[Others, Tensor]:
    """Return the others (`driven`, or by script) after a tick in which some take agents' actions, and who did."""
    state, road = episode.state, episode.road
    if commanded is None:
        commanded = torch.zeros_like(state.x, dtype=torch.bool)
        action = torch.zeros_like(state.x)[..., None].expand(-1, -1, 2)
    overridden = commanded if episode.overridden is None else commanded | episode.overridden
    released = overridden & ~commanded
    if bool(released[:, 1:].any()):
        if driven is None:
            seen = (state.seen_by(vehicle) for vehicle in range(state.x.shape[1]))
            views = (episode._replace(state=each, lead=lead_of(each, road)) for each in seen)
            by_rule = torch.stack([_RULE.act(view, None)[0] for view in views], dim=1)
            action, commanded = torch.where(released[..., None], by_rule, action), overridden
        else:
            others = _choose(released[:, 1:], drive_points(state, driven, dt, road), others)
    x, y, heading, speed = (field[:, 1:] for field in state[:4])
    curvature = None if road.reference_line is None else road.curvature(x)
    moved = Others(*bicycle(x, y, heading, speed, action[:, 1:, 0], action[:, 1:, 1], dt, curvature))
    return _choose(commanded[:, 1:], moved, others), overridden


def _choose(which: Tensor, one: Others, other: Others) -> Others:
    """Return one where `which` is set, boolean, shape (B, N - 1), and the other elsewhere, with its memory."""
    x, y, heading, speed = (torch.where(which, a, b) for a, b in zip(one[:4], other[:4], strict=True))
    return Others(x, y, heading, speed, getattr(other, "theta", None))


class Driver(Protocol):
    """An ego. Its memory, if it has any, goes in and out, so that one driver serves any number of rollouts.

    Example:
        >>> import torch
        >>> from rare_envs.scenarios.car_following import CAR_FOLLOWING
        >>> class Brake:
        ...     def act(self, episode, memory):
        ...         action = torch.tensor([-2.0, 0.0])  # acceleration [m/s^2], steering angle [rad]
        ...         return action.expand(len(episode.collided), 2), memory
        >>> x = torch.tensor([[20.0, 0.0, 120.0]])  # ego and lead speed [m/s], gap [m]
        >>> float(rollout(World(CAR_FOLLOWING), Brake(), x).state.speed[0, 0])  # after 10 s
        0.0
    """

    def act(self, episode: Episode, memory: Any) -> tuple[Tensor, Any]:
        """Decide for one tick.

        Args:
            episode: B scenarios at this moment; what is decided for those that have collided does not matter.
            memory: What the last call returned, None at the start.

        Returns:
            Acceleration [m/s^2] and steering angle [rad], shape (B, 2), or in a world with meta-actions these, shape
            (B,); and the new memory.
        """
        ...


def noise_columns(driver: Driver) -> int:
    """Return how many last columns of x are a driver's noise, which `with_draws` takes as standard normal draws."""
    return int(getattr(driver, "noise_columns", 0))  # anybody's object


def split_noise(driver: Driver, x: Tensor) -> tuple[Tensor, Driver]:
    """Return the world's part of x (B, d), and the driver with its noise, which are the columns behind it."""
    own, stochastic = noise_columns(driver), cast(Any, driver)
    return (x[:, :-own], stochastic.with_draws(x[:, -own:])) if own else (x, driver)


def drive(world: World, driver: Driver, x: Tensor) -> Iterator[Episode]:
    """Drive B scenarios, moment by moment.

    Args:
        world: The world.
        driver: The ego.
        x: Scenario parameters, shape (B, d), and behind them the noise of the ego, if it has `noise_columns`.

    Yields:
        The episodes at time 0 and after each tick up to the horizon. Rows in which the ego has collided are moved on
        with the others, but their f does not change any more.

    Example:
        >>> import torch
        >>> from rare_envs.control.idm import IDM
        >>> from rare_envs.scenarios.car_following import CAR_FOLLOWING
        >>> x = torch.tensor([[20.0, 15.0, 30.0]])  # ego and lead speed [m/s], gap [m]
        >>> len(list(drive(World(CAR_FOLLOWING), IDM(), x)))  # time 0 and 100 ticks
        101
    """
    x, driver = split_noise(driver, x)
    episode, memory = world.start(x), None
    yield episode
    for _ in range(world.clock.ticks):
        episode, memory = drive_tick(world, driver, episode, memory)
        yield episode


def drive_tick(world: World, driver: Driver, episode: Episode, memory: Any) -> tuple[Episode, Any]:
    """Return the episodes one tick later, and the driver's memory."""
    with as_errors():  # drivers and measures may be the user's
        action, memory = driver.act(episode, memory)
        episode, action = world.decode_meta_actions(episode, action)
        return world.step(episode, action), memory


def rollout(world: World, driver: Driver, x: Tensor) -> Episode:
    """Return the episodes of `drive` at the horizon; `.f` is the safety measure, shape (B,)."""
    for episode in drive(world, driver, x):
        last = episode
    return last
