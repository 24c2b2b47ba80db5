"""PilotNet has the layers of the paper and the colours of ITU-R BT.601."""

import numpy as np
import torch

from agents.vision.pilotnet import HEIGHT, WIDTH, PilotNet, luma


def pictures(n: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).integers(0, 256, (n, HEIGHT, WIDTH, 3), dtype=np.uint8))


def test_the_network_is_that_of_the_paper() -> None:
    """Bojarski et al., Fig. 4: sizes of the feature maps, and about 250,000 parameters."""
    network, maps = PilotNet(), []
    for convolution in network.convolutions:
        convolution.register_forward_hook(lambda _module, _given, out: maps.append(tuple(out.shape[1:])))
    with torch.no_grad():
        out = network(pictures(2), pictures(2)[..., 0], torch.tensor([3.0, 20.0]))
    assert out.shape == (2, 2)
    assert maps == [(24, 31, 98), (36, 14, 47), (48, 5, 22), (64, 3, 20), (64, 1, 18)]
    assert sum(weight.numel() for weight in network.parameters()) == 252_880


def test_channels_are_the_yuv_of_itu_bt_601() -> None:
    """U and V by their definitions as scaled differences of blue and red to the luma."""
    picture = pictures(1, 3)
    red, green, blue = (picture[..., k].double() for k in range(3))
    y = 0.299 * red + 0.587 * green + 0.114 * blue
    u, v = 0.436 * (blue - y) / (1 - 0.114), 0.615 * (red - y) / (1 - 0.299)
    earlier = pictures(1, 4)[..., 0]
    with torch.no_grad():
        channels = PilotNet().channels(picture, earlier).double()
    expected = torch.stack((y / 127.5 - 1, u / 127.5, v / 127.5, (y - earlier.double()) / 127.5), dim=1)
    assert channels.shape == (1, 4, HEIGHT, WIDTH)
    torch.testing.assert_close(channels, expected, atol=2e-5, rtol=0.0)
    assert float((luma(picture).double() - y).abs().max()) < 1.0
