"""Learned drivers: 51 features to acceleration and yaw rate, for whole batches of scenarios, and their files."""

from __future__ import annotations

import copy
from dataclasses import asdict, dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from agents import files
from agents.files import Provenance
from agents.learned.networks import (
    ACTION_SIZE,
    FEATURE_CLIP,
    FEATURE_SIZE,
    HEAD_SIZE,
    HIDDEN_SIZES,
    WHITE_NOISE,
    AutoregressiveNoise,
    Policy,
    Scaling,
    WeightDistribution,
)
from agents.learned.rules import STATE_SIZE, ChangeState, CollisionAvoidance, LaneChanges, Seen
from rare_envs.control import actions
from rare_envs.control.idm import IDM, yaw_rate_towards
from rare_envs.devices import constant
from rare_envs.sensors.lidar import AHEAD_BEAM, CURVATURE_COLUMN, FEATURES, MAX_RANGE, SPEED_COLUMN
from rare_envs.simulation.cuda_graphs import says_recordable
from rare_envs.simulation.observation import LIDAR_SCALES, observation_space
from rare_envs.traffic.bodies import Lead
from rare_envs.traffic.state import steering_for

if TYPE_CHECKING:
    from gymnasium import spaces

    from rare_envs.simulation.episode import Episode

EASED_BEYOND = 2.0
"""Deceleration [m/s^2] that is comfortable, as in `CollisionAvoidance`."""
_NOISE_SIZE = 2 * ACTION_SIZE
"""Numbers that a vehicle keeps in mind of its noise."""
_POLICY, _WEIGHTS = "policy.", "weights."
"""Beginnings of the names of tensors in files."""
_FORM = {"format": 1, "features": list(FEATURES), "feature_clip": FEATURE_CLIP}


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
        >>> import torch
        >>> from agents import load_driver
        >>> driver = load_driver("mgail")
        >>> driver.weights
        WeightDistribution(radius=0.01)
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
            low, high = (float(value) for value in getattr(self, name))  # a field by its name
            if not low < high:
                raise ValueError(f"Expected limits of {name} in ascending order, got {(low, high)}.")
            object.__setattr__(self, name, (low, high))
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
            memory: As `begin` or the last call returned it, shape (B, M, 2, 2), with lane changes (B, M, 14).

        Returns:
            Accelerations [m/s^2] and yaw rates [rad/s], shape (B, M, 2), and the new memory.
        """
        self._check_shapes(features, weights, innovations, memory)
        policy, (batch, vehicles, _) = self.policy, features.shape
        hidden = policy.trunk(features.to(policy.head.weight.dtype).reshape(batch * vehicles, FEATURE_SIZE))
        if weights is None:
            output = policy.head(hidden).view(batch, vehicles, 2 * ACTION_SIZE)
        else:
            layer = weights.to(hidden.dtype).contiguous().view(batch, 2 * ACTION_SIZE, HIDDEN_SIZES[-1] + 1)
            hidden = hidden.view(batch, vehicles, HIDDEN_SIZES[-1])
            output = torch.baddbmm(layer[:, None, :, -1], hidden, layer[:, :, :-1].mT)
        normal, log_std = policy.split(output)
        swings = None
        if memory is not None:
            swings = memory.flatten(2)[..., :_NOISE_SIZE].reshape(batch, vehicles, ACTION_SIZE, 2)
        if innovations is not None and swings is not None:
            noise, swings = self.colour.step(swings.to(hidden.dtype), innovations.to(hidden.dtype))
            normal = normal + log_std.exp() * noise
        action = self._limit(features, policy.scaling.action_mean + policy.scaling.action_std * normal)
        if self.avoidance is None:
            return action, swings
        seen = Seen.read(features)
        if self.changes is None or memory is None or swings is None:
            return self.avoidance.limit(seen, action), swings
        state = ChangeState.unpack(memory[..., _NOISE_SIZE:])
        action, state = self.changes.step(seen, state, innovations, action, self.avoidance)
        action = self.avoidance.limit(seen, torch.stack((action[..., 0], action[..., 1].clamp(*self.yaw_rate)), dim=-1))
        return action, torch.cat((swings.flatten(-2), state.pack().to(swings.dtype)), dim=-1)

    def _check_shapes(
        self, features: Tensor, weights: Tensor | None, innovations: Tensor | None, memory: Tensor | None
    ) -> None:
        """Refuse arguments of `act` of other shapes."""
        if features.ndim != 3 or features.shape[-1] != FEATURE_SIZE:
            raise ValueError(f"Expected features of shape (B, M, {FEATURE_SIZE}), got {tuple(features.shape)}.")
        batch, vehicles, _ = features.shape
        each = (ACTION_SIZE, 2) if self.changes is None else (_NOISE_SIZE + STATE_SIZE,)
        shapes = (batch, HEAD_SIZE), (batch, vehicles, ACTION_SIZE), (batch, vehicles, *each)
        given = {"weights": weights, "innovations": innovations, "memory": memory}
        for (name, value), shape in zip(given.items(), shapes, strict=True):
            if value is not None and value.shape != shape:
                raise ValueError(f"Expected {name} of shape {shape}, got {tuple(value.shape)}.")
        if innovations is not None and memory is None:
            raise ValueError("Expected a memory beside the innovations; at the start it is driver.begin(draws).")

    def _limit(self, features: Tensor, action: Tensor) -> Tensor:
        """Return actions (B, M, 2) within the limits, with a share of the braking beyond `EASED_BEYOND`."""
        low, high = constant(tuple(zip(self.acceleration, self.yaw_rate, strict=True)), action)
        action = action.clamp(low, high).to(features.dtype)
        if self.hard_braking == 1.0:
            return action
        acceleration, yaw_rate = action.unbind(dim=-1)
        eased = torch.maximum(acceleration, self.hard_braking * (acceleration + EASED_BEYOND) - EASED_BEYOND)
        return torch.stack((eased, yaw_rate), dim=-1)

    @property
    def recordable(self) -> bool:
        """Whether its operations may be recorded: no hooks; network, noise and rules are of this package's classes."""
        layers = (self.policy.first, self.policy.second, self.policy.head)
        if any(module._forward_hooks or module._forward_pre_hooks for module in (self.policy, *layers)):
            return False
        parts = (self.policy, *layers, self.colour, self.avoidance, self.changes)
        known = (Policy, *[nn.Linear] * 3, AutoregressiveNoise, CollisionAvoidance, LaneChanges)
        return all(part is None or type(part) is kind for part, kind in zip(parts, known, strict=True))

    def to(self, device: torch.device) -> LearnedDriver:
        """Return the driver with a copy of its network on a device."""
        return replace(self, policy=copy.deepcopy(self.policy).to(device))

    def begin(self, draws: Tensor) -> Tensor:
        """Return the memory at the start, from independent standard normal draws (B, M, 2, 2)."""
        swings = self.colour.begin(draws)
        if self.changes is None:
            return swings
        return torch.cat((swings.flatten(-2), self.changes.begin(draws[..., 1]).pack()), dim=-1)


@dataclass(frozen=True, eq=False)
class LearnedEgo:
    """A learned driver as ego: a Driver that acts by its mean actions and has no memory.

    Simulations call `act`, with any observation of the environment; `predict` is for the observation "lidar".

    Example:
        >>> import numpy as np
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
    def observation_space(self) -> spaces.Space[Any]:
        """Space of the observations of `predict`: "lidar"."""
        return observation_space(1, "lidar")

    @property
    def action_space(self) -> spaces.Box[np.float32]:
        """Space of the actions of `predict`: acceleration and steering in [-1, 1]."""
        return actions.action_space()

    def act(self, episode: Episode, memory: Any) -> tuple[Tensor, Any]:
        """Perceive and decide for one tick; see `rare_envs.simulation.world.Driver`."""
        if episode.perception is None:
            raise ValueError('Expected a world in which vehicles look: make it with observation="lidar".')
        return self._decide(episode.perception[:, 0]), memory

    def to(self, device: torch.device) -> LearnedEgo:
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
        """Return actions in [-1, 1], shape (B, 2), and the state, for observations "lidar", (B, 51); of one without B.

        The environment's actions reach to 5 m/s^2 and 0.1 rad, those of `act` as far as the driver's: where it brakes
        harder or steers further, this gives the limit. A ValueError says that the observation has another shape.
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
    """IDM behind what the beam ahead meets, with its lane keeping, in place of a `LearnedDriver`."""

    idm: IDM = field(default_factory=IDM)
    yaw_rate: tuple[float, float] = (-0.3, 0.3)
    """Limits [rad/s]."""
    weights: ClassVar[None] = None
    noisy: ClassVar[bool] = False
    recordable: ClassVar[bool] = True

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
        """Return accelerations [m/s^2] and yaw rates [rad/s] (B, M, 2) for features (B, M, 51), and the memory."""
        seen = Seen.read(features)
        ahead = seen.ranges[..., AHEAD_BEAM]
        gap = torch.where(ahead < MAX_RANGE, ahead - 0.5 * seen.length, torch.inf)
        acceleration = self.idm.acceleration(seen.speed, Lead(gap, -seen.rates[..., AHEAD_BEAM]))
        yaw_rate = yaw_rate_towards(seen.offset, seen.heading, seen.speed).clamp(*self.yaw_rate)
        return torch.stack((acceleration, yaw_rate), dim=-1), memory


# --- files --------------------------------------------------------------------------------------


def save_driver(driver: LearnedDriver, provenance: Provenance, path: str | PathLike[str]) -> Path:
    """Write a driver to one file; an interrupted call leaves no partial file.

    The path, which is returned, ends with .safetensors. A ValueError says that it does not, or of NaN and infinity.

    Example:
        >>> import tempfile
        >>> from agents import Provenance, load_driver, read_driver, read_provenance, save_driver
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     origin = Provenance(kind="gail", command="-", data="-", data_licence="CC0")
        ...     path = save_driver(load_driver("gail"), origin, f"{folder}/mine.safetensors")
        ...     print(read_driver(path).name, read_provenance(path).data_licence)
        gail CC0
    """
    tensors = {_POLICY + name: value for name, value in driver.policy.state_dict().items()}
    if driver.weights is not None:
        arrays = driver.weights.to_arrays()
        tensors |= {_WEIGHTS + name: torch.from_numpy(np.array(value)) for name, value in arrays.items()}
    header = {
        "name": driver.name,
        "log_std_cap": float(driver.policy.log_std_cap),
        "colour": asdict(driver.colour),
        "acceleration": driver.acceleration,
        "yaw_rate": driver.yaw_rate,
        "avoidance": None if driver.avoidance is None else asdict(driver.avoidance),
        "hard_braking": driver.hard_braking,
        "changes": None if driver.changes is None else asdict(driver.changes),
        "radius": None if driver.weights is None else driver.weights.radius,
    }
    return files.write_file(Path(path), tensors, files.DRIVER_ENTRY, {**_FORM, **header, **asdict(provenance)})


def read_driver(path: str | PathLike[str]) -> LearnedDriver:
    """Read a driver that `save_driver` wrote, onto the CPU and without gradients.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged, or was made for another form; the message says which.

    Example:
        >>> from importlib import resources
        >>> from agents import read_driver
        >>> read_driver(resources.files("agents") / "data" / "gail.safetensors").acceleration
        (-8.0, 4.0)
    """
    path = Path(path)
    header, tensors = files.read_file(path, files.DRIVER_ENTRY)
    files.check_form(header, _FORM, path)
    files.require(header, ("name", "colour", "acceleration", "yaw_rate", "radius"), path)
    sizes = (FEATURE_SIZE, FEATURE_SIZE, ACTION_SIZE, ACTION_SIZE)
    policy = files.read_network(lambda: Policy(Scaling(*map(torch.empty, sizes))), tensors, path, _POLICY)
    rule, changes = header.get("avoidance"), header.get("changes")  # earlier files have none
    names = () if header["radius"] is None else ("mean", "rows", "columns", "precision")
    files.require(tensors, [_WEIGHTS + name for name in names], path)
    arrays = {name: tensors[_WEIGHTS + name].numpy() for name in names}
    try:
        return LearnedDriver(
            policy,
            colour=AutoregressiveNoise(**header["colour"]),
            acceleration=header["acceleration"],
            yaw_rate=header["yaw_rate"],
            weights=WeightDistribution.from_arrays(arrays, header["radius"]) if arrays else None,
            avoidance=None if rule is None else CollisionAvoidance(**rule),
            hard_braking=header.get("hard_braking", 1.0),
            changes=None if changes is None else LaneChanges(**changes),
            name=header["name"],
        )
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(f"{str(path)!r} is no usable driver: {error}") from None
