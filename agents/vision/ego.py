"""The ego `vision`: PilotNet on pictures of the front camera and the own speed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agents.vision.pilotnet import ACCELERATION_UNIT, HEIGHT, TURN_UNIT, WIDTH, PilotNet, luma
from rare_envs.control.actions import MAX_ACCELERATION, MAX_STEERING, action_space
from rare_envs.simulation.observation import EGO_FEATURES, observation_space
from rare_envs.traffic.vehicle_models import steering_for

if TYPE_CHECKING:
    from gymnasium import spaces

OBSERVATION = "camera+speed"
"""Name of the observation."""
LAG = 5
"""Age of the earlier picture in ticks of 0.1 s: over 0.5 s a closing gap changes the picture visibly."""
MIN_STEERING_SPEED = 5.0
"""Below this speed [m/s] a yaw rate steers as at it: on a path of given curvature the yaw rate vanishes with speed."""
SPEED_SCALE = EGO_FEATURES[0].scale
"""Speed [m/s] of an observation of 1."""


@dataclass(frozen=True, eq=False)
class VisionEgo:
    """The ego with a camera: Stable-Baselines3's `predict`, with the luma of the last pictures as its memory.

    Example:
        >>> from agents import load_ego
        >>> ego = load_ego("vision")
        >>> observation = {"camera": np.zeros((2, 66, 200, 3), np.uint8), "speed": np.full((2, 1), 0.5, np.float32)}
        >>> action, state = ego.predict(observation)
        >>> action.shape, state.shape
        ((2, 2), (2, 5, 66, 200))
    """

    network: PilotNet
    dt: ClassVar[float] = 0.1
    """Tick [s] that it was trained with: its memory counts pictures."""

    @cached_property
    def observation_space(self) -> spaces.Space[Any]:
        """Space of the observation "camera+speed": a picture and the own speed."""
        return observation_space(1, OBSERVATION)

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
            deterministic: Not used; it always is.

        Returns:
            Actions in [-1, 1], shape (B, 2), and the new state.

        Raises:
            ValueError: If the observation has another form.
        """
        del deterministic
        picture, speed = _read_observation(observation)
        earlier, state = update_memory(picture, state, episode_start)
        outputs = self.network(picture, torch.from_numpy(earlier), speed)
        return to_actions(outputs, speed).numpy(), state


def update_memory(
    picture: Tensor, state: NDArray[np.uint8] | None, episode_start: NDArray[np.bool_] | None = None
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Add a picture to the memory.

    Args:
        picture: uint8, shape (B, H, W, 3).
        state: Luma of the `LAG` pictures before it, the oldest first, shape (B, LAG, H, W); None at the start.
        episode_start: Rows that begin an episode, shape (B,): their whole memory is this picture.

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
    """Return actions in [-1, 1] for the network's outputs (B, 2) at own speeds [m/s] (B,)."""
    steering = steering_for(TURN_UNIT * outputs[:, 1], speed.clamp(min=MIN_STEERING_SPEED))
    acceleration = ACCELERATION_UNIT / MAX_ACCELERATION * outputs[:, 0]
    return torch.stack((acceleration, steering / MAX_STEERING), dim=1).clamp(-1, 1)


def _read_observation(observation: dict[str, NDArray[Any]]) -> tuple[Tensor, Tensor]:
    """Return pictures, and speeds in m/s."""
    parts = {name: np.asarray(part) for name, part in observation.items()} if isinstance(observation, dict) else {}
    shapes = {name: (part.shape, str(part.dtype)) for name, part in parts.items()}
    picture, speed = parts.get("camera"), parts.get("speed")
    if picture is None or speed is None or picture.shape[1:] != (HEIGHT, WIDTH, 3) or picture.dtype != np.uint8:
        raise ValueError(
            f"Expected pictures 'camera', uint8 of shape (B, {HEIGHT}, {WIDTH}, 3), and 'speed', (B, 1), got "
            f'{shapes or type(observation).__name__}; make the environment with observation="{OBSERVATION}".'
        )
    if speed.shape != (len(picture), 1):
        raise ValueError(f"Expected 'speed' of shape ({len(picture)}, 1), got {speed.shape}.")
    return torch.from_numpy(np.ascontiguousarray(picture)), torch.from_numpy(
        speed[:, 0].astype(np.float32)
    ) * SPEED_SCALE
