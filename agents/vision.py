"""The ego `vision`: PilotNet on pictures of the front camera and the own speed, and the file of its weights.

References:
    Bojarski et al., "End to end learning for self-driving cars", 2016 (arXiv 1604.07316): the layers, and pictures of
    66 x 200 in YUV.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from agents import files
from agents.files import SUFFIX, VISION, Provenance
from rare_envs.control.actions import MAX_ACCELERATION, MAX_STEERING, action_space
from rare_envs.simulation.observation import EGO_SCALES, observation_space
from rare_envs.traffic.state import steering_for

if TYPE_CHECKING:
    from gymnasium import spaces

HEIGHT, WIDTH = 66, 200
"""Height and width of the pictures [pixels]."""
PILOTNET_HIDDEN_UNITS, OUTPUT_SIZE = 50, 2
"""Units of the layer that `PilotNet.hidden` gives; acceleration and yaw rate."""
ACCELERATION_UNIT, TURN_UNIT = 2.0, 0.1
"""Outputs are in these units [m/s^2, rad/s]."""
YUV = ((0.299, 0.587, 0.114), (-0.14713, -0.28886, 0.436), (0.615, -0.51499, -0.10001))
"""Luma and colour differences of red, green and blue (ITU-R BT.601, analogue scales)."""
_USUAL_SPEED, _SPEED_SPREAD = 15.0, 7.5
"""Speeds are normalised by these [m/s]: about the mean and spread of the speeds in training."""
_BYTE_CENTRE = 127.5
"""Half of the range of a byte."""
OBSERVATION = "camera+speed"
"""Name of the observation."""
LAG = 5
"""Age of the earlier picture in ticks of 0.1 s: over 0.5 s a closing gap changes the picture visibly."""
MIN_STEERING_SPEED = 5.0
"""Below this speed [m/s] a yaw rate steers as at it: on a path of given curvature the yaw rate vanishes with speed."""
SPEED_SCALE = EGO_SCALES["speed"]
"""Speed [m/s] of an observation of 1."""
_FORM: Mapping[str, Any] = {"format": 1, "observation": OBSERVATION, "picture": [HEIGHT, WIDTH], "lag": LAG}
"""Observation that a network was trained for; a file with another one is refused."""


def luma(picture: Tensor) -> Tensor:
    """Return the brightness (B, H, W) of pictures (B, H, W, 3), in integers, whose bits depend on no batch."""
    red, green, blue = picture.to(torch.int32).unbind(-1)
    return ((77 * red + 150 * green + 29 * blue + 128) >> 8).to(torch.uint8)


class PilotNet(nn.Module):
    """Normalisation, five convolutions and three dense layers, as published; the input and the output differ.

    Beside the YUV of the picture there is a fourth channel, the change of brightness since an earlier picture, because
    one picture does not tell how fast a gap closes. The ego's own speed joins the units of the first dense layer.
    """

    def __init__(self) -> None:
        """Draw the weights from the global generator of torch."""
        super().__init__()
        sizes = ((4, 24, 5, 2), (24, 36, 5, 2), (36, 48, 5, 2), (48, 64, 3, 1), (64, 64, 3, 1))
        self.convolutions = nn.ModuleList(nn.Conv2d(a, b, kernel, stride) for a, b, kernel, stride in sizes)
        self.first = nn.Linear(64 * 18, 100)
        self.second = nn.Linear(100 + 1, PILOTNET_HIDDEN_UNITS)
        self.last = nn.Linear(PILOTNET_HIDDEN_UNITS, 10)
        self.head = nn.Linear(10, OUTPUT_SIZE)
        for layer in (*self.convolutions, self.first, self.second, self.last):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)
        self.arrange()

    def arrange(self) -> PilotNet:
        """Lay the weights out as the pictures are, channels last, which convolves twice as fast; return the network."""
        for layer in cast(Iterable[nn.Conv2d], self.convolutions):
            layer.weight.data = layer.weight.data.contiguous(memory_format=torch.channels_last)
        return self

    def channels(self, picture: Tensor, earlier: Tensor) -> Tensor:
        """Return Y, U, V and Y less the earlier Y, uint8 (B, 66, 200): about -1 to 1, (B, 4, 66, 200)."""
        like = self.head.weight
        image = like.new_empty(*picture.shape[:3], 4)
        image[..., :3] = picture.to(like.dtype) @ like.new_tensor(YUV).T
        image[..., 3] = image[..., 0] - earlier
        image.mul_(1.0 / _BYTE_CENTRE)
        image[..., 0] -= 1.0
        return image.movedim(3, 1)  # in memory channels stay last

    def hidden(self, picture: Tensor, earlier: Tensor, speed: Tensor) -> Tensor:
        """Return the hidden units (B, 50); arguments as in `forward`."""
        features = self.channels(picture, earlier)
        for convolution in self.convolutions:
            features = torch.relu(convolution(features))
        scaled = (speed.to(features.dtype) - _USUAL_SPEED) / _SPEED_SPREAD
        units = torch.relu(self.first(features.flatten(1)))
        return torch.relu(self.second(torch.cat((units, scaled[:, None]), dim=1)))

    def out(self, hidden: Tensor) -> Tensor:
        """Return the outputs (B, 2) of hidden units (B, 50)."""
        outputs: Tensor = self.head(torch.relu(self.last(hidden)))
        return outputs

    def forward(self, picture: Tensor, earlier: Tensor, speed: Tensor) -> Tensor:
        """Return acceleration and yaw rate (B, 2) in units of `ACCELERATION_UNIT` and `TURN_UNIT`.

        Pictures are uint8 (B, 66, 200, 3), the luma of `LAG` ticks before (B, 66, 200), own speeds [m/s] (B,).
        """
        return self.out(self.hidden(picture, earlier, speed))


@dataclass(frozen=True, eq=False)
class VisionEgo:
    """The ego with a camera: Stable-Baselines3's `predict`, with the luma of the last pictures as its memory."""

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
        """Return actions in [-1, 1] (B, 2), and the luma of the last pictures (B, 5, 66, 200), the oldest first."""
        picture, speed = _read_observation(observation)
        earlier, state = update_memory(picture, state, episode_start)
        outputs = self.network(picture, torch.from_numpy(earlier), speed)
        return to_actions(outputs, speed).numpy(), state


def update_memory(
    picture: Tensor, state: NDArray[np.uint8] | None, episode_start: NDArray[np.bool_] | None = None
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the luma of `LAG` pictures ago (B, H, W), and the memory (B, LAG, H, W) with a picture added.

    The whole memory of rows that begin an episode is this picture (B, H, W, 3).
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
    """Return pictures, and speeds in m/s (B,)."""
    parts = {name: np.asarray(part) for name, part in observation.items()} if isinstance(observation, dict) else {}
    picture, speed = parts.get("camera", np.empty(0)), parts.get("speed", np.empty(0))
    if picture.shape[1:] != (HEIGHT, WIDTH, 3) or picture.dtype != np.uint8 or speed.shape != (len(picture), 1):
        shapes = {name: (part.shape, str(part.dtype)) for name, part in parts.items()}
        raise ValueError(
            f"Expected pictures 'camera', uint8 of shape (B, {HEIGHT}, {WIDTH}, 3), and 'speed', (B, 1), got "
            f'{shapes or type(observation).__name__}; make the environment with observation="{OBSERVATION}".'
        )
    scaled = torch.from_numpy(speed[:, 0].astype(np.float32)) * SPEED_SCALE
    return torch.from_numpy(np.ascontiguousarray(picture)), scaled


def load_vision(name: str | PathLike[str] = VISION) -> VisionEgo:
    """Return the ego `vision`, or one from a file that `save_vision` wrote."""
    path = files.SHIPPED / f"{VISION}{SUFFIX}" if str(name) == VISION else Path(name)
    header, tensors = files.read_file(path, files.VISION_ENTRY)
    files.check_form(header, _FORM, path)
    return VisionEgo(files.read_network(PilotNet, tensors, path).arrange())


def save_vision(network: PilotNet, provenance: Provenance, path: str | PathLike[str]) -> Path:
    """Write a network to one .safetensors, and return its path."""
    return files.write_file(Path(path), network.state_dict(), files.VISION_ENTRY, {**_FORM, **asdict(provenance)})
