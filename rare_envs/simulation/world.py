"""The world: a scenario with its drivers, its clock and its measure, as pure functions from episode to episode."""

from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import Any

import torch
from gymnasium import spaces
from torch import Tensor

from rare_envs.control.meta_actions import DECISION, follow_meta_actions, initial_aim
from rare_envs.distributions.space import Distribution, Parameter
from rare_envs.measures import EpisodeMeasure, Moment
from rare_envs.measures.registry import find_measure
from rare_envs.scenarios.base import Scenario
from rare_envs.sensors.camera import Camera, CameraContext, clear_day
from rare_envs.sensors.camera.weather import read_weather, weather_parameters
from rare_envs.sensors.kinds import kinds_of
from rare_envs.sensors.perception import perceive_traffic
from rare_envs.simulation.background import Background, BackgroundState, fixed_draws, noise_size, step_background
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.episode_statistics import EpisodeStatistics
from rare_envs.simulation.observation import observation_space
from rare_envs.simulation.overrides import apply_overrides
from rare_envs.traffic.crash import others_overlap
from rare_envs.traffic.lead import lead_of
from rare_envs.traffic.overlap import ego_overlaps
from rare_envs.traffic.road import WorldPose
from rare_envs.traffic.state import State
from rare_envs.traffic.vehicle_models import bicycle

WeatherDistributions = tuple[tuple[tuple[Parameter, ...], Distribution], ...]


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


@dataclass(frozen=True)
class World:
    """A scenario, its tick, its measure and its drivers. Nothing here changes, and nothing is random."""

    scenario: Scenario
    dt: float = 0.1
    """Tick [s]."""
    horizon: float | None = None
    """Length of an episode [s]; None takes the scenario's."""
    measure: Any = "ttc"
    """What `rare_envs.measures.registry.find_measure` takes: a name, a `Measure`, a function of a `Moment`."""
    drivers: Background | None = None
    """Of the vehicles around the ego; None for the scenario's script."""
    noise: bool | str = True
    """Drivers' noise: True, part of x; "fixed", one sequence for all x; False, mean actions."""
    observation: str = "features"
    """What the ego observes: one of `rare_envs.sensors.kinds.OBSERVATIONS`, or several joined by "+"."""
    action: str = "continuous"
    """What a policy decides: "continuous", each tick, or "meta", each second."""
    lidar: bool = False
    """Look even if neither drivers nor measure nor observation ask for it."""
    collisions: str = "ego"
    """Which collisions count: those of the "ego", or "any", those between other vehicles too."""
    witnessed: bool = False
    """Keep the least time to collision and who crashed with whom; see `Episode.statistics`."""
    camera: Camera = Camera()  # noqa: RUF009  (frozen)
    """What takes the pictures where "camera" is observed."""
    weather: bool = False
    """Whether there is weather in x; a camera sees it."""

    def __post_init__(self) -> None:
        if not (_is_number(self.dt) and 0.0 < self.dt <= 1.0):
            raise ValueError(f"Expected dt in (0, 1] s, got {self.dt!r}.")
        if self.horizon is None:
            object.__setattr__(self, "horizon", self.scenario.horizon)
        whole = _is_number(self.horizon) and self.dt <= self.seconds < 1e6
        if not whole or abs(self.seconds / self.dt - self.ticks) > 1e-6:
            raise ValueError(f"Expected a horizon of one or more whole ticks of {self.dt} s, got {self.horizon!r}.")
        for what, seconds in (("dt", 1.0 / self.dt), ("horizon", self.seconds / DECISION)):
            if self.action == "meta" and abs(seconds - round(seconds)) > 1e-6:
                raise ValueError(
                    f"Expected a dt that divides 1 s and a horizon of whole seconds with action='meta', in which a "
                    f"decision takes 1 s; got {what} = {getattr(self, what)!r}."
                )
        find_measure(self.measure)
        if self.collisions not in ("ego", "any"):
            raise ValueError(f"Expected collisions 'ego' or 'any', got {self.collisions!r}.")
        if not (isinstance(self.noise, bool) or self.noise == "fixed"):
            raise ValueError(f"Expected noise True, False or 'fixed', got {self.noise!r}.")
        if self.drivers is not None and self.dt != 0.1:
            raise ValueError(f"Expected dt = 0.1 s, the tick that these drivers learned with, got {self.dt!r}.")

    @property
    def seconds(self) -> float:
        """Length of an episode [s]."""
        return self.scenario.horizon if self.horizon is None else self.horizon

    @property
    def ticks(self) -> int:
        """Length of an episode in ticks."""
        return round(self.seconds / self.dt)

    @property
    def stride(self) -> int:
        """Ticks from one decision of a policy to the next."""
        return round(DECISION / self.dt) if self.action == "meta" else 1

    @property
    def sees(self) -> bool:
        """Whether the vehicles look at every moment."""
        needed = self.drivers is not None or self._measure.sees
        return self.lidar or needed or "lidar" in kinds_of(self.observation)

    @property
    def recorded(self) -> bool:
        """Whether the measure keeps whole episodes."""
        return bool(getattr(self._measure, "records", False))

    @cached_property
    def _measure(self) -> EpisodeMeasure:
        return find_measure(self.measure)

    @property
    def weights(self) -> int:
        """Number of columns of x that are weights of the drivers."""
        return 0 if self.drivers is None or self.drivers.weights is None else self.drivers.weights.dim

    @property
    def draws(self) -> int:
        """Number of columns of x that are drivers' noise."""
        return noise_size(self.ticks, self._others) if self._noisy and self.noise is True else 0

    @property
    def conditions(self) -> int:
        """Number of columns of x that are weather."""
        return sum(each.size for parameters, _ in self.weather_distributions for each in parameters)

    @property
    def weather_distributions(self) -> WeatherDistributions:
        """Parameters of the weather with their laws, in the order of x."""
        return tuple(weather_parameters(self.noise is not False)) if self.weather else ()

    @property
    def keys(self) -> int:
        """Number of columns of x, the last, from which the camera's noise follows: 1 or 0."""
        return int(self.weather and self.noise is True)

    @property
    def _others(self) -> int:
        return self.scenario.vehicles - 1

    @property
    def _noisy(self) -> bool:
        return self.drivers is not None and self.drivers.noisy and self.noise is not False

    @cached_property
    def _fixed(self) -> Tensor:
        return fixed_draws(self.ticks, self._others)

    def start(self, x: Tensor) -> Episode:
        """Begin B episodes.

        Args:
            x: Scenario parameters, weather, drivers' weights, drivers' noise and the key of the camera's noise side by
                side, shape (B, d), within the physical box; dtype and device are kept.

        Returns:
            The episodes at time 0.
        """
        sizes = [self.scenario.size, self.conditions, self.weights, self.draws, self.keys]
        own, weather, weights, noise, key = torch.split(x, sizes, dim=1)
        state = self.scenario.initial(own)
        background_state = None
        if self.drivers is not None:
            background_state = BackgroundState.start(self.drivers, weights.contiguous(), self._draws(noise))
        camera_context = None
        if "camera" in kinds_of(self.observation):
            camera_context = CameraContext.at_start(
                self.camera, read_weather(weather, key) if self.weather else clear_day(x)
            )
        return self.first(state, self._look(state, self._placed(state)), background_state, camera_context)

    def first(
        self,
        state: State,
        perception: Tensor | None,
        background_state: BackgroundState | None = None,
        camera_context: CameraContext | None = None,
    ) -> Episode:
        """Episodes at time 0.

        Args:
            state: Of B scenarios; the vehicle in the ego's place is the one whose episodes these are.
            perception: What the vehicles see, in the same order.
            background_state: Of the drivers around the ego.
            camera_context: Of a camera on the vehicle in the ego's place.
        """
        road = self.scenario.road
        collided = torch.zeros_like(state.x[:, 0], dtype=torch.bool)
        moment = Moment(state, lead_of(state, road), road, perception, None, self.dt)
        measure_state = self._measure.start(moment, self.ticks)
        aim = initial_aim(state, road) if self.action == "meta" else None
        seen = EpisodeStatistics.start(moment, self._least_ttc(measure_state)) if self.witnessed else None
        return Episode(
            state,
            moment.lead,
            measure_state,
            collided,
            road,
            perception,
            background_state,
            None,
            self._measure,
            aim,
            seen,
            camera_context,
        )

    def next(self, episode: Episode, state: State, perception: Tensor | None, hit: Tensor) -> Episode:
        """Episodes one tick later; background_state and who has overridden stay as they were.

        Args:
            episode: Before the tick.
            state: After it.
            perception: What the vehicles see then.
            hit: Whether the vehicle in the ego's place touches another or is off the road, boolean, shape (B,).
        """
        moment = Moment(state, lead_of(state, episode.road), episode.road, perception, episode.state, self.dt)
        collided = episode.collided | hit
        measure_state = self._measure.update(episode.measure_state, moment, episode.collided, collided)
        seen = episode.statistics
        if seen is not None:
            seen = seen.update(moment, episode.collided, collided, self._least_ttc(measure_state))
            episode = episode._replace(statistics=seen)
        camera_context = None if episode.camera_context is None else episode.camera_context.later()
        return episode._replace(
            state=state,
            lead=moment.lead,
            measure_state=measure_state,
            collided=collided,
            perception=perception,
            camera_context=camera_context,
        )

    def _least_ttc(self, measure_state: Any) -> Tensor | None:
        """The least time to collision, where that is the measure."""
        return measure_state if self.measure == "ttc" else None

    def _draws(self, noise: Tensor) -> Tensor:
        """Draws of the drivers' noise as tensors, shape (B, 2 + T, M, 2), or (B, 0, M, 2)."""
        batch, shape = len(noise), (self._others, 2)
        if self._noisy and self.noise == "fixed":
            return self._fixed.to(noise).expand(batch, -1, -1, -1)
        return noise.reshape(batch, -1 if self._noisy else 0, *shape)

    def _look(self, state: State, placed: WorldPose | None) -> Tensor | None:
        """What the vehicles see, if they look."""
        return perceive_traffic(state, self.scenario.road, placed) if self.sees else None

    def _placed(self, state: State) -> WorldPose | None:
        """Where the vehicles are in the flat world, if they look."""
        return self.scenario.road.place(state.x, state.y, state.heading) if self.sees else None

    def decode_meta_actions(
        self, episode: Episode, action: Tensor, commanded: Tensor | None = None
    ) -> tuple[Episode, Tensor]:
        """Turn meta-actions, if such they are, into what the vehicles' controllers do in this tick.

        Args:
            episode: B episodes.
            action: As in `step`.
            commanded: As in `step`.

        Returns:
            The episodes with their new aims, and accelerations [m/s^2] and steering angles [rad] in a last axis of 2.
        """
        if episode.aim is None or action.is_floating_point():
            return episode, action
        aim, action = follow_meta_actions(episode.aim, action, commanded, episode.state, episode.road)
        return episode._replace(aim=aim), action

    def step(self, episode: Episode, action: Tensor, commanded: Tensor | None = None) -> Episode:
        """Move every vehicle by one tick: all decide on the old state, then all move.

        A collision (a vehicle's body overlaps the ego's, or the ego's centre leaves the road, which is walled) is
        remembered; whoever steps on after it gets motion without meaning, but an unchanged f.

        A vehicle that is commanded moves as the ego does, by the bicycle model. One that has been and no longer is goes
        on from where it is: with the world's drivers, or by IDM and lane keeping where there was a script, which
        knows its path only.

        Args:
            episode: B episodes.
            action: Acceleration [m/s^2] and steering angle [rad] of the ego, shape (B, 2); with `commanded` of all
                vehicles, shape (B, N, 2). In a world with meta-actions also those, whole numbers of shape (B,) or
                (B, N): a decision, and `IDLE` in the ticks that follow it.
            commanded: Which vehicles obey their action, boolean, shape (B, N); the ego always does. None if the
                others keep their drivers.

        Returns:
            The episodes one tick later.
        """
        episode, action = self.decode_meta_actions(episode, action, commanded)
        old, dt, road, background_state = episode.state, self.dt, episode.road, episode.background_state
        steered = action if commanded is None else action[:, 0]
        ego = (old.x[:, 0], old.y[:, 0], old.heading[:, 0], old.speed[:, 0])
        curvature = None if road.reference_line is None else road.curvature(old.x[:, 0])
        moved = bicycle(*ego, steered[:, 0], steered[:, 1], dt, curvature)
        decided = None
        if self.drivers is None or background_state is None or episode.perception is None:
            others = self.scenario.others(old, dt)
        else:
            decided, background_state = step_background(self.drivers, background_state, episode.perception[:, 1:])
            others = self.scenario.driven(old, decided, dt)
        overridden = episode.overridden
        if commanded is not None or overridden is not None:
            others, overridden = apply_overrides(episode, action, commanded, others, decided, dt)
        x, y, heading, speed = (torch.cat((first[None], rest.T)).T for first, rest in zip(moved, others, strict=True))
        state = State(x, y, heading, speed, old.theta)
        placed = self._placed(state)
        hit = ego_overlaps(state, road, placed).any(dim=1) | road.off_road(state.y[:, 0])
        if self.collisions == "any":
            hit = hit | others_overlap(state, road)
        episode = episode._replace(background_state=background_state, overridden=overridden)
        return self.next(episode, state, self._look(state, placed), hit)


def space_of_observations(world: "World") -> spaces.Space[Any]:
    """What an ego observes in a world."""
    return observation_space(world.scenario.vehicles, world.observation, world.camera)
