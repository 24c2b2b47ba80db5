"""The ego `vision`: PilotNet on pictures of the front camera and the own speed, and the file of its weights.

References:
    Bojarski et al., "End to end learning for self-driving cars", 2016 (arXiv 1604.07316): the layers, and pictures of
    66 x 200 in YUV.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from agents.learned.checkpoints import SUFFIX, Provenance, check_finite, check_tensor, read_file, require, write_file
from agents.names import VISION
from rare_envs.control.actions import MAX_ACCELERATION, MAX_STEERING, action_space
from rare_envs.simulation.observation import EGO_FEATURES, observation_space
from rare_envs.traffic.vehicle_models import steering_for

if TYPE_CHECKING:
    from gymnasium import spaces

HEIGHT, WIDTH = 66, 200
"""Height and width of the pictures [pixels]."""
OUTPUT_SIZE = 2
"""Acceleration and yaw rate."""
PILOTNET_HIDDEN_UNITS = 50
"""Units of the layer that `PilotNet.hidden` gives."""
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
SPEED_SCALE = EGO_FEATURES[0].scale
"""Speed [m/s] of an observation of 1."""
_ENTRY = "vision"
_FORMAT: Mapping[str, Any] = {"format": 1, "observation": OBSERVATION, "picture": [HEIGHT, WIDTH], "lag": LAG}
"""Observation that a network was trained for; a file with another one is refused."""


def luma(picture: Tensor) -> Tensor:
    """Return the brightness of pictures, computed in integers: the same bits whatever the batch.

    The coefficients are those of `YUV` times 256, rounded.

    Args:
        picture: uint8, red, green and blue last, shape (B, H, W, 3).

    Returns:
        uint8, shape (B, H, W).

    Example:
        >>> luma(torch.tensor([[[[255, 0, 0], [255, 255, 255]]]], dtype=torch.uint8)).tolist()
        [[[77, 255]]]
    """
    red, green, blue = picture.to(torch.int32).unbind(-1)
    return ((77 * red + 150 * green + 29 * blue + 128) >> 8).to(torch.uint8)


class PilotNet(nn.Module):
    """Normalisation, five convolutions and three dense layers, as published; the input and the output differ.

    Beside the YUV of the picture there is a fourth channel, the change of brightness since an earlier picture, because
    one picture does not tell how fast a gap closes. The ego's own speed joins the units of the first dense layer.

    Example:
        >>> picture = torch.zeros(2, HEIGHT, WIDTH, 3, dtype=torch.uint8)
        >>> tuple(PilotNet()(picture, luma(picture), torch.tensor([10.0, 20.0])).shape)
        (2, 2)
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
        """Return the four channels of the input, about -1 to 1.

        Args:
            picture: uint8, red, green and blue last, shape (B, 66, 200, 3).
            earlier: Luma of an earlier picture, uint8, shape (B, 66, 200).

        Returns:
            Y, U, V, and Y less the earlier Y, shape (B, 4, 66, 200).
        """
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
        """Return acceleration and yaw rate.

        Args:
            picture: uint8, red, green and blue last, shape (B, 66, 200, 3).
            earlier: Luma of the picture `agents.vision.LAG` ticks before, uint8, shape (B, 66, 200).
            speed: Own speed [m/s], shape (B,).

        Returns:
            Acceleration and yaw rate in units of `ACCELERATION_UNIT` and `TURN_UNIT`, shape (B, 2).
        """
        return self.out(self.hidden(picture, earlier, speed))


# --- ego ---------------------------------------------------------------------------------------------------------


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


# --- files -------------------------------------------------------------------------------------------------------


def load_vision(name: str | PathLike[str] = VISION) -> VisionEgo:
    """Load the ego `vision`, or one from a file that `save_vision` wrote.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: It holds something else, or was made for other pictures.

    Example:
        >>> sorted(load_vision().observation_space)
        ['camera', 'speed']
    """
    if str(name) == VISION:
        with resources.as_file(resources.files("agents") / "data" / f"{VISION}{SUFFIX}") as path:
            return VisionEgo(_read_network(path))
    return VisionEgo(_read_network(Path(name)))


def save_vision(network: PilotNet, provenance: Provenance, path: str | PathLike[str]) -> Path:
    """Write a network to one file.

    Raises:
        ValueError: If the path has another ending than .safetensors, or a weight is NaN or infinite.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     origin = Provenance(kind="untrained", command="-", data="-", data_licence="CC0")
        ...     path = save_vision(PilotNet(), origin, Path(folder) / "mine.safetensors")
        ...     print(read_vision_provenance(path).kind, type(load_vision(path)).__name__)
        untrained VisionEgo
    """
    tensors = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    return write_file(Path(path), tensors, _ENTRY, {**_FORMAT, **asdict(provenance)})


def read_vision_provenance(path: str | PathLike[str]) -> Provenance:
    """Read the origin of a network; raises as `load_vision` does.

    Example:
        >>> from importlib import resources
        >>> read_vision_provenance(resources.files("agents") / "data" / "vision.safetensors").kind
        'imitation of a driver by rule with on-policy corrections (DAgger), corrected'
    """
    header, _ = read_file(Path(path), _ENTRY)
    require(header, (f.name for f in fields(Provenance)), Path(path))
    return Provenance(**{f.name: header[f.name] for f in fields(Provenance)})


def holds_vision(path: str | PathLike[str]) -> bool:
    """Return whether a file holds a network with a camera; False if it cannot be read."""
    try:
        with safe_open(path, framework="pt") as file:
            return _ENTRY in (file.metadata() or {})
    except (SafetensorError, OSError):
        return False


def _read_network(path: Path) -> PilotNet:
    """Read a network onto the CPU, without gradients."""
    header, tensors = read_file(path, _ENTRY)
    for name, ours in _FORMAT.items():
        if header.get(name) != ours:
            raise ValueError(f"{str(path)!r} has {name} {header.get(name)!r}; this version reads {ours!r}.")
    check_finite(tensors, path)
    with torch.device("meta"):  # shapes only: initial weights would be drawn from the global generator
        network = PilotNet()
    expected = network.state_dict()
    require(tensors, expected, path)
    for name, value in expected.items():
        check_tensor(name, tensors[name], tuple(value.shape), torch.float32, path)
    network.load_state_dict({name: tensors[name] for name in expected}, assign=True)
    return network.arrange().eval().requires_grad_(False)
