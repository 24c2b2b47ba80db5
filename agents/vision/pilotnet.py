"""PilotNet: a convolutional network from pictures of a front camera to acceleration and yaw rate.

References:
    Bojarski et al., "End to end learning for self-driving cars", 2016 (arXiv 1604.07316): the layers, and pictures of
    66 x 200 in YUV.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import cast

import torch
from torch import Tensor, nn

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
            earlier: Luma of the picture `agents.vision.ego.LAG` ticks before, uint8, shape (B, 66, 200).
            speed: Own speed [m/s], shape (B,).

        Returns:
            Acceleration and yaw rate in units of `ACCELERATION_UNIT` and `TURN_UNIT`, shape (B, 2).
        """
        return self.out(self.hidden(picture, earlier, speed))
