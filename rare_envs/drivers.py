"""Drivers: what decides an acceleration and a steering angle. IDM, lane keeping and policies with `predict`."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from torch import Tensor

from rare_envs.actions import IDLE
from rare_envs.asking import Asked, ask
from rare_envs.dynamics import NEAR_ZERO, steering_for
from rare_envs.geometry import Lead
from rare_envs.mixed import each
from rare_envs.observation import observe
from rare_envs.road import Road
from rare_envs.state import VEHICLE_LENGTH

if TYPE_CHECKING:
    from rare_envs.world import Episode


class Driver(Protocol):
    """An ego. Its memory, if it has any, goes in and out, so that one driver serves any number of rollouts."""

    def act(self, episode: "Episode", memory: Any) -> tuple[Tensor, Any]:
        """Decide for one tick.

        Args:
            episode: B scenarios at this moment; what is decided for those that have collided does not matter.
            memory: What the last call returned, None at the start.

        Returns:
            Acceleration [m/s^2] and steering angle [rad], shape (B, 2), or in a world with meta-actions these, shape
            (B,); and the new memory.
        """
        ...


@dataclass(frozen=True)
class IDM:
    """Intelligent Driver Model with a hard maximum deceleration, on the bumper-to-bumper gap.

    a = a_max [1 - (v/v0)^delta - (s*/gap)^2], at least -b_max, with
    s* = s0 + s1 sqrt(v/v0) + T v + v dv / (2 sqrt(a_max b)).

    The defaults are Tian et al.'s (2024, Table I; as found in their group's public code). The last term of s* is not
    cut off at 0: a lead that pulls away fast from a short gap is braked for, as in HighwayEnv and in their code.
    """

    desired_speed: float = 21.72
    """v0 [m/s]."""
    time_headway: float = 1.2
    """T [s]."""
    max_acceleration: float = 2.22
    """a_max [m/s^2]."""
    comfortable_deceleration: float = 2.4
    """b [m/s^2]."""
    exponent: float = 4.0
    """delta."""
    jam_distance: float = 1.0
    """s0 [m]."""
    jam_distance_speed: float = 2.0
    """s1 [m]."""
    max_deceleration: float = 5.0
    """b_max [m/s^2]: what the brakes can do."""
    added_length: float = 0.0
    """[m] added to the gap; HighwayEnv measures between centres, so its jam distance contains a vehicle length."""

    @classmethod
    def highway_env(cls, desired_speed: float) -> "IDM":
        """HighwayEnv's `IDMVehicle`: distance between centres, jam distance 10 m, accelerations within 6 m/s^2."""
        return cls(desired_speed, 1.5, 3.0, 5.0, 4.0, 10.0, 0.0, 6.0, VEHICLE_LENGTH)

    def acceleration(self, speed: Tensor, lead: Lead, desired_speed: Tensor | None = None) -> Tensor:
        """The IDM acceleration.

        Args:
            speed: Speed of the follower [m/s], shape (B,).
            lead: Its lead.
            desired_speed: v0 [m/s] of each follower, shape (B,), in place of the common one.

        Returns:
            Acceleration [m/s^2], shape (B,).
        """
        v0 = self.desired_speed if desired_speed is None else desired_speed
        ratio = speed / v0
        closing_gain = 0.5 / (self.max_acceleration * self.comfortable_deceleration) ** 0.5
        wanted = self.jam_distance + speed * (self.time_headway + lead.closing_speed * closing_gain)
        if self.jam_distance_speed:
            wanted = wanted + self.jam_distance_speed * ratio.clamp(min=1e-24).sqrt()  # a finite slope at standstill
        crowding = wanted / (lead.gap + self.added_length).clamp(min=NEAR_ZERO)
        free = ratio.square().square() if self.exponent == 4.0 else ratio.pow(self.exponent)
        acceleration: Tensor = self.max_acceleration * (1.0 - free - crowding.square())
        return acceleration.clamp(min=-self.max_deceleration)

    def act(self, episode: "Episode", memory: Any) -> tuple[Tensor, Any]:
        """IDM behind the lead, lane keeping across; no memory."""
        state = episode.state
        speed = state.speed[:, 0]
        steering = lane_keeping(state.y[:, 0], state.heading[:, 0], speed, episode.road)
        return torch.stack((self.acceleration(speed, episode.lead), steering), dim=1), memory


def lane_keeping(y: Tensor, heading: Tensor, speed: Tensor, road: Road) -> Tensor:
    """HighwayEnv's steering controller, towards the centre of the nearest lane.

    Offset to heading command (proportional, 0.6 s), heading error to yaw rate (0.2 s), yaw rate to steering angle.
    On a curve of radius R it runs wide by 0.12 s^2 v^2 / R, 3 cm at 30 m/s on the I-80.

    Args:
        y: Position across the road [m], shape (B,).
        heading: Heading [rad], shape (B,).
        speed: Speed [m/s], shape (B,).
        road: The road they are on.

    Returns:
        Steering angle [rad], shape (B,).
    """
    return steering_control(y - road.centre_of(y), heading, speed)


def steering_control(offset: Tensor, heading: Tensor, speed: Tensor) -> Tensor:
    """HighwayEnv's steering controller (`ControlledVehicle.steering_control`) towards a line.

    Args:
        offset: Place to the right of the line [m], any shape; the other tensors have the same.
        heading: Heading relative to the line [rad].
        speed: Speed [m/s].

    Returns:
        Steering angle [rad].
    """
    speed = speed.clamp(min=NEAR_ZERO)
    heading_command = torch.asin((offset / (-0.6 * speed)).clamp(-1.0, 1.0)).clamp(-np.pi / 4, np.pi / 4)
    yaw_rate = 5.0 * (heading_command - heading)
    return steering_for(yaw_rate, speed)


@dataclass(frozen=True)
class PolicyDriver:
    """Any object with Stable-Baselines3's `predict`, called on the whole batch."""

    policy: Any
    observation: str = "features"
    """What it observes."""
    action: str = "continuous"
    """What its actions are."""
    stride: int = 1
    """It is asked every so many ticks; meta-actions only are carried out in between."""
    lost: dict[int, str] | None = None
    """Where rows are written down on which the policy fails, with the reason; None if such a failure is raised."""

    def act(self, episode: "Episode", memory: Any) -> tuple[Tensor, Any]:
        """Observe, and ask the policy for its mean action; a recurrent policy's hidden state is the memory.

        No episode shows a policy what comes after its collision, so those rows are shown what another row sees, and
        their actions are ignored. So it is with rows that are lost.

        Raises:
            ValueError: If the policy's actions are not finite or have the wrong shape, and rows cannot be lost.
        """
        state, over = episode.state, episode.collided
        batch = len(over)
        hidden, tick = (None, 0) if memory is None else memory
        if tick % self.stride:
            return torch.full((batch,), IDLE, device=state.x.device), (hidden, tick + 1)
        if self.lost:
            over = over.clone()
            over[list(self.lost)] = True
        seen = observe(episode, self.observation)
        observation = each(lambda part: _replaced(part, over).numpy(force=True), seen)
        start = np.full(batch, memory is None)
        given, hidden = ask(self.policy, self.action, Asked(observation, hidden, start, over), self.lost)
        return given.to(state.x) if given.is_floating_point() else given, (hidden, tick + 1)


def _replaced(observation: Tensor, rows: Tensor) -> Tensor:
    """An observation with what the first other row sees in some rows; zeros if there is no other."""
    wide = rows.view(-1, *[1] * (observation.ndim - 1))
    if bool(rows.all()):
        return observation.masked_fill(wide, 0)
    return torch.where(wide, observation[int((~rows).int().argmax())], observation)
