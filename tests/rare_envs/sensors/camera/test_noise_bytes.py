"""Sums of bytes by both kinds of integers."""

import torch

from rare_envs.sensors.camera.noise_bytes import add_bytes, add_bytes_unsigned


def test_signed_and_unsigned_integers_give_the_same_noise() -> None:
    """The first are those of a graphics card, the second those of a processor."""
    rng = torch.Generator().manual_seed(3)
    key, place = (torch.randint(-(2**31), 2**31, (n,), generator=rng).to(torch.int32) for n in (50, 3000))
    assert torch.equal(add_bytes(key, place), add_bytes_unsigned(key, place))
