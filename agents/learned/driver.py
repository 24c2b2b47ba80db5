"""Learned drivers: 51 features to acceleration and yaw rate, for whole batches of scenarios at once."""

import copy
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agents.learned.collision_avoidance import CollisionAvoidance
from agents.learned.lane_changes import STATE_SIZE, ChangeState, LaneChanges
from agents.learned.networks import (
    ACTION_SIZE,
    FEATURE_SIZE,
    HEAD_SIZE,
    HIDDEN_SIZES,
    HUMAN_NOISE,
    WHITE_NOISE,
    AutoregressiveNoise,
    Policy,
    apply_heads,
    is_plain,
)
from agents.learned.weight_distribution import WeightDistribution
from rare_envs.control import actions
from rare_envs.control.idm import IDM
from rare_envs.devices import constant
from rare_envs.sensors.lidar import (
    AHEAD_BEAM,
    CURVATURE_COLUMN,
    FEATURES,
    HEADING_COLUMN,
    LANE_OFFSET_COLUMN,
    MAX_RANGE,
    RANGE_COLUMNS,
    RATE_COLUMNS,
    SPEED_COLUMN,
)
from rare_envs.simulation.cuda_graphs import says_recordable
from rare_envs.simulation.observation import LIDAR_SCALES, observation_space
from rare_envs.traffic.neighbours import Lead
from rare_envs.traffic.vehicle_models import NEAR_ZERO, steering_for

if TYPE_CHECKING:
    from gymnasium import spaces

    from rare_envs.simulation.episode import Episode

EASED_BEYOND = 2.0
"""Deceleration [m/s^2] that is comfortable, as in `CollisionAvoidance`."""
OFFSET_TIME = 0.6
"""The lateral speed that is aimed at is lane offset / this [s], as in `rare_envs.control.idm`."""
HEADING_TIME = 0.2
"""The yaw rate is heading error / this [s], as in `rare_envs.control.idm`."""
_LENGTH = FEATURES.index("length")


@dataclass(frozen=True, eq=False)
class LearnedDriver:
    """A driver of the traffic: a Gaussian policy with the colour of its noise and the limits of its actions.

    The actions of a vehicle at tick t are

        action = action_mean + action_std (mean + exp(log_std) eps_t), within the limits,

    where every eps_t is N(0, 1) and autocorrelated, see `AutoregressiveNoise`. O'Kelly et al. (2018) sample white
    noise, `AutoregressiveNoise()`.

    Raises:
        ValueError: If limits are out of order, or there are not 404 weights.

    Example:
        >>> from agents import load_driver
        >>> driver = load_driver("mgail")
        >>> driver.weights
        WeightDistribution(404 weights, radius=0.01)
        >>> action, memory = driver.act(torch.zeros(4, 6, 51))
        >>> tuple(action.shape), memory
        ((4, 6, 2), None)
    """

    policy: Policy = field(repr=False)
    colour: AutoregressiveNoise = WHITE_NOISE
    """Of the noise of acceleration and yaw rate."""
    acceleration: tuple[float, float] = (-8.0, 4.0)
    """Limits [m/s^2]."""
    yaw_rate: tuple[float, float] = (-0.3, 0.3)
    """Limits [rad/s]."""
    weights: WeightDistribution | None = None
    """Distribution of the 404 weights of the last layer; None if no ensemble was fitted."""
    name: str = "learned"
    """Names the driver in results, such as "mgail"."""
    avoidance: CollisionAvoidance | None = None
    """Rule that bounds the actions; None for the network's own."""
    hard_braking: float = 1.0
    """Share of what the network brakes beyond `EASED_BEYOND` that it is given; the rule brakes as it has to."""
    changes: LaneChanges | None = None
    """Lane changes, which need the rule; None for those of the network."""
    noisy: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for name in ("acceleration", "yaw_rate"):
            pair = tuple(float(value) for value in getattr(self, name))  # a field by its name
            if len(pair) != ACTION_SIZE:
                raise ValueError(f"Expected {name} as two numbers, got {pair}.")
            object.__setattr__(self, name, pair)
        for name in ("acceleration", "yaw_rate"):
            low, high = getattr(self, name)  # a field by its name
            if not low < high:
                raise ValueError(f"Expected limits of {name} in ascending order, got {(low, high)}.")
        if not 0.0 < self.hard_braking <= 1.0:
            raise ValueError(f"Expected a share of hard braking in (0, 1], got {self.hard_braking!r}.")
        if self.changes is not None and self.avoidance is None:
            raise ValueError("Expected a rule of collision avoidance beside the lane changes, got none.")
        if self.weights is not None and self.weights.dim != HEAD_SIZE:
            raise ValueError(f"Expected a distribution of {HEAD_SIZE} weights, got one of {self.weights.dim}.")

    def act(
        self,
        features: Tensor,
        weights: Tensor | None = None,
        innovations: Tensor | None = None,
        memory: Tensor | None = None,
    ) -> tuple[Tensor, Tensor | None]:
        """Decide for one tick, in one forward pass of all vehicles, also when their weights differ.

        Args:
            features: What M vehicles in B scenarios perceive, shape (B, M, 51).
            weights: Last layers of the scenarios, shape (B, 404) as `head_weights` has them; None for the policy's own.
            innovations: Independent standard normal draws, shape (B, M, 2); None for the mean actions.
            memory: As the last call returned it; at the start that of `begin`. Shape (B, M, 2, 2), of the noise, and
                with lane changes (B, M, 14).

        Returns:
            Accelerations [m/s^2] and yaw rates [rad/s], shape (B, M, 2), and the new memory.

        Raises:
            TypeError: If something is no tensor.
            ValueError: If a shape is wrong, or innovations come without a memory.
        """
        batch, vehicles = _check_shapes(features, weights, innovations, memory, self._memory_shape)
        policy = self.policy
        hidden = policy.trunk(features.to(policy.head.weight.dtype).reshape(batch * vehicles, FEATURE_SIZE))
        if weights is None:
            output = policy.head(hidden).view(batch, vehicles, 2 * ACTION_SIZE)
        else:
            output = apply_heads(hidden.view(batch, vehicles, HIDDEN_SIZES[-1]), weights.to(hidden.dtype).contiguous())
        normal, log_std = policy.split(output)
        swings, state = self._split(memory)
        if innovations is not None and swings is not None:
            noise, swings = self.colour.step(swings.to(hidden.dtype), innovations.to(hidden.dtype))
            normal = normal + log_std.exp() * noise
        scaling = policy.scaling
        action = scaling.action_mean + scaling.action_std * normal
        low, high = constant(tuple(zip(self.acceleration, self.yaw_rate, strict=True)), action)
        action = self._ease_braking(action.clamp(low, high).to(features.dtype))
        if state is None or swings is None:
            return self._bound(features, action), memory if swings is None else swings
        action, state = self._change_lanes(features, action, state, innovations)
        return self._bound(features, action), torch.cat((swings.flatten(-2), state.pack().to(swings.dtype)), dim=-1)

    @property
    def _memory_shape(self) -> tuple[int, ...]:
        """Shape of the memory of one vehicle."""
        return (ACTION_SIZE, 2) if self.changes is None else (2 * ACTION_SIZE + STATE_SIZE,)

    def _split(self, memory: Tensor | None) -> tuple[Tensor | None, ChangeState | None]:
        """Return the memory of the noise, (B, M, 2, 2), and that of the lane changes."""
        if memory is None or self.changes is None:
            return memory, None
        swings = memory[..., : 2 * ACTION_SIZE].reshape(*memory.shape[:-1], ACTION_SIZE, 2)
        return swings, ChangeState.unpack(memory[..., 2 * ACTION_SIZE :])

    def _ease_braking(self, action: Tensor) -> Tensor:
        """Return actions with a share of the braking beyond `EASED_BEYOND`."""
        if self.hard_braking == 1.0:
            return action
        acceleration, yaw_rate = action.unbind(dim=-1)
        eased = torch.maximum(acceleration, self.hard_braking * (acceleration + EASED_BEYOND) - EASED_BEYOND)
        return torch.stack((eased, yaw_rate), dim=-1)

    def _change_lanes(
        self, features: Tensor, action: Tensor, state: ChangeState, innovations: Tensor | None
    ) -> tuple[Tensor, ChangeState]:
        """Return actions with the course of a lane change for the steering of those who are in one."""
        assert self.changes is not None
        assert self.avoidance is not None
        change, state = self.changes.step(features, state, innovations)
        bound = self.avoidance.greatest_acceleration_behind(change.gap, change.closing, features[..., SPEED_COLUMN])
        acceleration = torch.where(change.follows, torch.minimum(action[..., 0], bound), action[..., 0])
        left, right = self.avoidance.greatest_yaw_rates_within(features, change.room)
        inside = torch.minimum(torch.maximum(action[..., 1], -left), right)
        yaw_rate = torch.where(change.changing, change.yaw_rate, inside).clamp(*self.yaw_rate)
        return torch.stack((acceleration, yaw_rate), dim=-1), state

    def _bound(self, features: Tensor, action: Tensor) -> Tensor:
        """Return actions within the bounds of the rule, if there is one."""
        return action if self.avoidance is None else self.avoidance.limit(features, action)

    @property
    def recordable(self) -> bool:
        """Whether its operations may be recorded: network, noise and rules are of this package."""
        return is_plain(self.policy) and self._has_known_rules()

    def _has_known_rules(self) -> bool:
        """Return whether its noise and rules are of this package: subclasses may do anything."""
        rule, changes = self.avoidance, self.changes
        parts, known = (self.colour, rule, changes), (AutoregressiveNoise, CollisionAvoidance, LaneChanges)
        return all(part is None or type(part) is kind for part, kind in zip(parts, known, strict=True))

    def without_rules(self) -> "LearnedDriver":
        """Return the network alone, with the noise of recorded driving: no bounds and no lane changes by rule."""
        return replace(self, colour=HUMAN_NOISE, avoidance=None, hard_braking=1.0, changes=None)

    def to(self, device: torch.device) -> "LearnedDriver":
        """Return the driver with a copy of its network on a device."""
        return replace(self, policy=copy.deepcopy(self.policy).to(device))

    def begin(self, draws: Tensor) -> Tensor:
        """Return the memory at the start, from independent standard normal draws (B, M, 2, 2).

        The patience for lane changes is made of the second draws, which balanced noise leaves.
        """
        swings = self.colour.begin(draws)
        if self.changes is None:
            return swings
        return torch.cat((swings.flatten(-2), self.changes.begin(draws[..., 1]).pack()), dim=-1)


def _check_shapes(
    features: Tensor,
    weights: Tensor | None,
    innovations: Tensor | None,
    memory: Tensor | None,
    each: tuple[int, ...],
) -> tuple[int, int]:
    """Return B and M; `each` is the shape of the memory of one vehicle."""
    named = {"features": features, "weights": weights, "innovations": innovations, "memory": memory}
    for name, value in named.items():
        if not isinstance(value, Tensor) and (value is not None or name == "features"):
            raise TypeError(f"Expected {name} as a torch.Tensor, got {type(value).__name__}; use torch.as_tensor.")
    if features.ndim != 3 or features.shape[-1] != FEATURE_SIZE:
        raise ValueError(f"Expected features of shape (B, M, {FEATURE_SIZE}), got {tuple(features.shape)}.")
    batch, vehicles, _ = features.shape
    if weights is not None and weights.shape != (batch, HEAD_SIZE):
        raise ValueError(f"Expected weights of shape ({batch}, {HEAD_SIZE}), got {tuple(weights.shape)}.")
    expected = (batch, vehicles, ACTION_SIZE)
    if innovations is not None and innovations.shape != expected:
        raise ValueError(f"Expected innovations of shape {expected}, got {tuple(innovations.shape)}.")
    if innovations is not None and memory is None:
        raise ValueError("Expected a memory beside the innovations; at the start it is driver.begin(draws).")
    if memory is not None and memory.shape != (batch, vehicles, *each):
        raise ValueError(f"Expected memory of shape {(batch, vehicles, *each)}, got {tuple(memory.shape)}.")
    return batch, vehicles


def replace_head(policy: Policy, weights: Tensor) -> Policy:
    """Return a copy of a network with other weights (404,) in its last layer, as `head_weights` has them.

    Raises:
        ValueError: If there are not 404 weights.

    Example:
        >>> from agents import load_driver
        >>> changed = replace_head(load_driver("gail").policy, torch.zeros(404))
        >>> changed(torch.zeros(1, 51))[0].tolist()
        [[0.0, 0.0]]
    """
    if weights.shape != (HEAD_SIZE,):
        raise ValueError(f"Expected weights of shape ({HEAD_SIZE},), got {tuple(weights.shape)}.")
    changed = copy.deepcopy(policy)
    layer = weights.detach().view(2 * ACTION_SIZE, HIDDEN_SIZES[-1] + 1)
    with torch.no_grad():
        changed.head.weight.copy_(layer[:, :-1])
        changed.head.bias.copy_(layer[:, -1])
    return changed


@dataclass(frozen=True, eq=False)
class LearnedEgo:
    """A learned driver as ego: a Driver that acts by its mean actions and has no memory.

    Simulations call `act`, whatever the environment observes. `predict` is for those who step an environment
    themselves, made with `observation="lidar"`.

    Example:
        >>> from agents import load_ego
        >>> ego = load_ego("imitation")
        >>> action, state = ego.predict(np.zeros((3, 51), np.float32))
        >>> action.shape, state
        ((3, 2), None)
    """

    driver: LearnedDriver
    needs_lidar: ClassVar[bool] = True
    """It needs a world in which vehicles look."""

    @property
    def recordable(self) -> bool:
        """Whether its operations may be recorded: as of the driver."""
        return says_recordable(self.driver)

    @property
    def observation_space(self) -> "spaces.Space[Any]":
        """Space of the observations of `predict`: "lidar"."""
        return observation_space(1, "lidar")

    @property
    def action_space(self) -> "spaces.Box[np.float32]":
        """Space of the actions of `predict`: acceleration and steering in [-1, 1]."""
        return actions.action_space()

    def act(self, episode: "Episode", memory: Any) -> tuple[Tensor, Any]:
        """Perceive and decide for one tick; see `rare_envs.simulation.rollout.Driver`."""
        if episode.perception is None:
            raise ValueError('Expected a world in which vehicles look: make it with observation="lidar".')
        return self._decide(episode.perception[:, 0]), memory

    def to(self, device: torch.device) -> "LearnedEgo":
        """Return the ego with a copy of its network on a device."""
        return replace(self, driver=self.driver.to(device))

    @torch.inference_mode()
    def predict(
        self,
        observation: NDArray[np.float32],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        """Choose actions as a Stable-Baselines3 model does, for the observation "lidar".

        The environment's actions reach to 5 m/s^2 and 0.1 rad, those of `act` as far as the driver's: where it brakes
        harder or steers further, this gives the limit.

        Args:
            observation: Of one environment, shape (51,), or of B, shape (B, 51).
            state: Returned as it is.
            episode_start: Not used.
            deterministic: Not used; the actions are the mean ones either way.

        Returns:
            Actions in [-1, 1], shape (2,) or (B, 2), and the state.

        Raises:
            ValueError: If the observation has another shape.
        """
        del episode_start, deterministic
        seen = torch.as_tensor(np.asarray(observation, dtype=np.float32))
        if seen.ndim not in (1, 2) or seen.shape[-1] != FEATURE_SIZE:
            raise ValueError(
                f"Expected observations of shape (B, {FEATURE_SIZE}), got {tuple(seen.shape)}; "
                'make the environment with observation="lidar".'
            )
        physical = self._decide(seen.reshape(-1, FEATURE_SIZE) * seen.new_tensor(LIDAR_SCALES))
        scaled = physical / physical.new_tensor((actions.MAX_ACCELERATION, actions.MAX_STEERING))
        return scaled.clamp(-1.0, 1.0).reshape(*seen.shape[:-1], ACTION_SIZE).numpy(), state

    def _decide(self, features: Tensor) -> Tensor:
        """Return acceleration [m/s^2] and steering angle [rad], shape (B, 2), for features of the egos (B, 51)."""
        action, _ = self.driver.act(features[:, None])
        acceleration, yaw_rate = action[:, 0].unbind(dim=-1)
        speed = features[:, SPEED_COLUMN]
        yaw_rate = yaw_rate + speed * features[:, CURVATURE_COLUMN]  # it was trained on a straight road
        return torch.stack((acceleration, steering_for(yaw_rate, speed)), dim=1)


@dataclass(frozen=True)
class RuleDriver:
    """IDM behind what the beam ahead meets, and the lane keeping of `rare_envs.control.idm` as a yaw rate.

    It has the interface of a `LearnedDriver`, so that one harness measures both; it has no weights and no noise, and
    knows vehicles in its lane only where the beam meets them.

    Example:
        >>> import torch
        >>> actions, _ = RuleDriver().act(torch.zeros(1, 1, 51))
        >>> actions.shape
        torch.Size([1, 1, 2])
    """

    idm: IDM = field(default_factory=IDM)
    yaw_rate: tuple[float, float] = (-0.3, 0.3)
    """Limits [rad/s]."""
    weights: ClassVar[None] = None
    noisy: ClassVar[bool] = False
    recordable: ClassVar[bool] = True
    """Whether its operations may be recorded: nothing about it changes."""

    def begin(self, draws: Tensor) -> Tensor:
        """Return an empty memory: (B, M, 2, 2) -> (B, M, 0)."""
        return draws[..., 0, :0]

    def act(
        self,
        features: Tensor,
        weights: Tensor | None = None,
        innovations: Tensor | None = None,
        memory: Tensor | None = None,
    ) -> tuple[Tensor, Tensor | None]:
        """Decide for one tick.

        Args:
            features: Shape (B, M, 51).
            weights: Not used.
            innovations: Not used.
            memory: Returned as it is.

        Returns:
            Accelerations [m/s^2] and yaw rates [rad/s], shape (B, M, 2), and the memory.
        """
        ahead, rate = features[..., RANGE_COLUMNS][..., AHEAD_BEAM], features[..., RATE_COLUMNS][..., AHEAD_BEAM]
        speed = features[..., SPEED_COLUMN]
        gap = torch.where(ahead < MAX_RANGE, ahead - 0.5 * features[..., _LENGTH], torch.inf)
        acceleration = self.idm.acceleration(speed, Lead(gap, -rate))
        across = -features[..., LANE_OFFSET_COLUMN] / (OFFSET_TIME * speed.clamp(min=NEAR_ZERO))
        wanted = torch.asin(across.clamp(-1.0, 1.0)).clamp(-torch.pi / 4, torch.pi / 4)
        yaw_rate = ((wanted - features[..., HEADING_COLUMN]) / HEADING_TIME).clamp(*self.yaw_rate)
        return torch.stack((acceleration, yaw_rate), dim=-1), memory
