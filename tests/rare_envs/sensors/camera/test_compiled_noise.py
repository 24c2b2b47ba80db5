"""Compiled noise against that of NumPy, to the bit."""

import numpy as np
import pytest
import torch

from rare_envs.sensors.camera import sensor_noise
from rare_envs.sensors.camera.noise_bytes import add_bytes_unsigned


def test_compiled_noise_has_the_same_bits() -> None:
    pytest.importorskip("numba", reason="compiled noise needs numba")
    from rare_envs.sensors.camera.compiled_noise import add_bytes_compiled

    assert sensor_noise._find_compiled_noise() is add_bytes_compiled
    words = [np.random.default_rng(3).integers(0, 2**32, n, dtype=np.uint32) for n in (50, 3001)]
    expected = add_bytes_unsigned(*(torch.from_numpy(each.view(np.int32)) for each in words))
    np.testing.assert_array_equal(add_bytes_compiled(*words), expected.numpy())
