"""Sensor noise by compiled code: the bits of `noise_bytes.add_bytes_unsigned`. Importing this module needs numba."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rare_envs.compilation import compiled, single
from rare_envs.sensors.camera.noise_bytes import BOTH_HALVES, BYTES_DEVIATION, BYTES_MEAN, EVEN_BYTES, MIXING_FACTORS

_WORD: Any = np.uint32
_FIRST, _SECOND = (_WORD(factor % 2**32) for factor in MIXING_FACTORS)
_LOW, _PAIRS, _HALF, _FIFTEEN, _BYTE = _WORD(EVEN_BYTES), _WORD(BOTH_HALVES), _WORD(16), _WORD(15), _WORD(8)
_CENTRE, _SCALE = single(BYTES_MEAN, BYTES_DEVIATION)


def add_bytes_compiled(key: NDArray[np.uint32], place: NDArray[np.uint32]) -> NDArray[np.float32]:
    """Return the scaled sums of bytes for keys (B,) and places (V,), shape (B, V).

    Example:
        >>> noise = add_bytes_compiled(np.arange(2, dtype=np.uint32), np.arange(1000, dtype=np.uint32))
        >>> noise.shape, str(noise.dtype)
        ((2, 1000), 'float32')
    """
    noise = np.empty((len(key), len(place)), dtype=np.float32)
    _fill(np.array(key), np.array(place), noise)  # of their own: numba compiles anew for arrays that cannot be written
    return noise


@compiled
def _fill(key: NDArray[np.uint32], place: NDArray[np.uint32], noise: NDArray[np.float32]) -> None:
    """Write the noise of each camera, (B, V); numba widens integers, which are cut to 32 bits again."""
    for i in range(len(key)):
        for j in range(len(place)):
            bits = _WORD(place[j] + key[i])
            bits = _WORD((bits ^ (bits >> _HALF)) * _FIRST)
            bits = _WORD((bits ^ (bits >> _FIFTEEN)) * _SECOND)
            bits = _WORD(bits ^ (bits >> _HALF))
            pairs = _WORD((_WORD(bits >> _BYTE) & _LOW) + (bits & _LOW))
            total = _WORD(_WORD(pairs * _PAIRS) >> _HALF)
            noise[i, j] = (np.float32(np.int32(total)) - _CENTRE) / _SCALE
