"""Sensor noise: the hash in plain integers, the exact distribution of its values, and that they are white."""

import math

import pytest
import torch

from rare_envs.sensors.camera import Camera, CameraContext, Weather
from rare_envs.sensors.pictures import draw_pixel_noise

N = 3 * 66 * 200
"""Values of a picture."""
KEYS = (0, 1, 2**30, 1065353216, 1065353217)
GOLDEN = 2654435761
"""2^32 over the golden ratio, a prime."""
WORD = 2**32


def cameras(*keys: int, tick: int = 0, viewer: int = 0) -> CameraContext:
    context = CameraContext.at_start(Camera(), Weather(*torch.zeros(4, len(keys)), torch.tensor(keys)))
    return context._replace(tick=context.tick + tick, viewer=viewer)


def lowbias32(x: int) -> int:
    """Wellons' mixing function, as published."""
    x ^= x >> 16
    x = x * 0x7FEB352D % WORD
    x ^= x >> 15
    x = x * 0x846CA68B % WORD
    return x ^ x >> 16


def slow_noise(key: int, tick: int, viewer: int, place: int) -> float:
    """One value of the noise: the sum of the four bytes of a hash, less its mean, over its standard deviation."""
    bits = key
    for number in (tick, viewer):
        bits = lowbias32((bits + (number + 1) * GOLDEN) % WORD)
    bits = lowbias32((bits + place * GOLDEN) % WORD)
    return (sum(bits.to_bytes(4, "big")) - 4 * 127.5) / math.sqrt(4 * (256**2 - 1) / 12)


@pytest.mark.parametrize(("tick", "viewer"), [(0, 0), (1, 0), (99, 5)])
def test_equal_to_the_hash_in_plain_integers(tick: int, viewer: int) -> None:
    found = draw_pixel_noise(cameras(*KEYS, tick=tick, viewer=viewer), N)
    for row, key in zip(found, KEYS, strict=True):
        for place in (0, 1, 2, 255, 600, N - 1):
            assert row[place].item() == pytest.approx(slow_noise(key, tick, viewer, place), abs=1e-6)


def test_noise_is_white() -> None:
    """Within pictures and between those of different keys, ticks and viewers."""
    pictures = [
        draw_pixel_noise(cameras(*KEYS, tick=tick, viewer=viewer), N) for tick, viewer in ((0, 0), (1, 0), (0, 1))
    ]
    for values in pictures:
        assert values.mean(dim=1).abs().max() < 5 / math.sqrt(N)
        assert (values.var(dim=1) - 1).abs().max() < 5 * math.sqrt(2 / N)
        for lag in (1, 3, 600, 66 * 200):  # along rows, channels and columns
            together = (values[:, lag:] * values[:, :-lag]).mean(dim=1)
            assert together.abs().max() < 5 / math.sqrt(N - lag)
    pairs = torch.cat(pictures)
    across = torch.corrcoef(pairs) - torch.eye(len(pairs))
    assert across.abs().max() < 5 / math.sqrt(N)
