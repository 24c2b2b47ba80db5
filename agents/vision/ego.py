"""The ego `vision`: PilotNet on the front camera, and its own speed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agents.vision.pilotnet import ACCELERATION, HEIGHT, TURN, WIDTH, PilotNet, luma
from rare_envs.control.actions import MAX_ACCELERATION, MAX_STEERING, action_space
from rare_envs.simulation.observation import EGO_FEATURES, observation_space
from rare_envs.traffic.vehicle_models import steering_for

if TYPE_CHECKING:
    from gymnasium import spaces

SEES = "camera+speed"
"""What it observes."""
LAG = 5
"""Ticks of 0.1 s that the earlier picture is old."""
MIN_STEERING_SPEED = 5.0
"""Below this speed [m/s] a turn steers as at it: the turn of a path of given curvature goes to 0 with the speed."""
SPEED_SCALE = EGO_FEATURES[0].scale
"""[m/s] of an observed speed of 1."""


@dataclass(frozen=True, eq=False)
class VisionEgo:
    """A network that sees, as ego: Stable-Baselines3's `predict`, with the last pictures as its memory."""

    network: PilotNet
    dt: ClassVar[float] = 0.1
    """Time between two pictures [s] that its memory counts on."""

    @cached_property
    def observation_space(self) -> spaces.Space[Any]:
        """A picture and the own speed, the observation "camera+speed"."""
        return observation_space(1, SEES)

    @cached_property
    def action_space(self) -> spaces.Box[np.float32]:
        """Acceleration and steering in [-1, 1]."""
        return action_space()

    @torch.inference_mode()
    def predict(
        self,
        observation: dict[str, NDArray[Any]],
        state: NDArray[np.uint8] | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Choose actions as a Stable-Baselines3 model does.

        Args:
            observation: "camera", uint8 of shape (B, 66, 200, 3), and "speed", shape (B, 1).
            state: Luma of the last pictures, the oldest first, uint8, shape (B, 5, 66, 200); None at the start.
            episode_start: Rows that begin an episode, shape (B,); they remember the present picture only.
            deterministic: Passed over; it always is.

        Returns:
            Actions in [-1, 1], shape (B, 2), and the new state.

        Raises:
            ValueError: If the observation has another form.
        """
        del deterministic
        picture, speed = _read(observation)
        earlier, state = recall(picture, state, episode_start)
        outputs = self.network(picture, torch.from_numpy(earlier), speed)
        return to_actions(outputs, speed).numpy(), state


def recall(
    picture: Tensor, state: NDArray[np.uint8] | None, episode_start: NDArray[np.bool_] | None = None
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """What is remembered when a picture is taken.

    Args:
        picture: uint8, shape (B, H, W, 3).
        state: Luma of the `LAG` pictures before it, the oldest first, shape (B, LAG, H, W); None at the start.
        episode_start: Rows that begin an episode, shape (B,): there it is as if all pictures had been this one.

    Returns:
        The luma of `LAG` pictures ago, shape (B, H, W), and the state to pass on.
    """
    now = luma(picture).numpy()
    start = np.full(len(now), state is None)
    if episode_start is not None:
        start = start | np.asarray(episode_start, dtype=bool)
    past = np.empty((len(now), LAG, *now.shape[1:]), np.uint8) if state is None else state
    past = np.where(start[:, None, None, None], now[:, None], past) if start.any() else past
    return past[:, 0], np.concatenate((past[:, 1:], now[:, None]), axis=1)


def to_actions(outputs: Tensor, speed: Tensor) -> Tensor:
    """Actions in [-1, 1] for the network's outputs (B, 2) at own speeds [m/s] (B,)."""
    steering = steering_for(TURN * outputs[:, 1], speed.clamp(min=MIN_STEERING_SPEED))
    return torch.stack((ACCELERATION / MAX_ACCELERATION * outputs[:, 0], steering / MAX_STEERING), dim=1).clamp(-1, 1)


def _read(observation: dict[str, NDArray[Any]]) -> tuple[Tensor, Tensor]:
    """Pictures, and speeds in m/s."""
    parts = {name: np.asarray(part) for name, part in observation.items()} if isinstance(observation, dict) else {}
    shapes = {name: (part.shape, str(part.dtype)) for name, part in parts.items()}
    picture, speed = parts.get("camera"), parts.get("speed")
    if picture is None or speed is None or picture.shape[1:] != (HEIGHT, WIDTH, 3) or picture.dtype != np.uint8:
        raise ValueError(
            f"Expected pictures 'camera', uint8 of shape (B, {HEIGHT}, {WIDTH}, 3), and 'speed', (B, 1), got "
            f'{shapes or type(observation).__name__}; make the environment with observation="{SEES}".'
        )
    if speed.shape != (len(picture), 1):
        raise ValueError(f"Expected 'speed' of shape ({len(picture)}, 1), got {speed.shape}.")
    return torch.from_numpy(np.ascontiguousarray(picture)), torch.from_numpy(
        speed[:, 0].astype(np.float32)
    ) * SPEED_SCALE
