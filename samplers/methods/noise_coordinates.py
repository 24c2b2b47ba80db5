"""Noise coordinates: the part of x that is a simulation's own randomness is drawn afresh for every point, not searched.

The randomness of learned drivers, or of a stack of sensors, is hundreds of coordinates of x that are standard normal
and matter little one by one. Wide draws of all of them are nothing like noise, and no proposal describes failures in so
many dimensions. Drawn from their own distribution they cost nothing: with Z ~ N(0, I) for the noise,
p = E[P(f(X, Z) <= gamma | X)], and weights are those of X alone. f is then noisy for the search, and still every
simulated x replays.
"""

from typing import cast

import numpy as np
from numpy.typing import NDArray

from samplers.problem import Distribution, FloatArray, HasNoise, Inputs


def noise_mask(inputs: Inputs) -> NDArray[np.bool_]:
    """Return which coordinates of x are noise, shape (d,): none where the base distribution does not say."""
    noise = inputs.base.noise if isinstance(inputs.base, HasNoise) else None
    return np.zeros(inputs.dim, dtype=bool) if noise is None else np.asarray(noise, dtype=bool)


def marginalise_noise(inputs: Inputs, rng: np.random.Generator) -> Inputs:
    """Return the inputs to search: these themselves where none of them is noise, or all are."""
    noise = noise_mask(inputs)
    return inputs if not noise.any() or noise.all() else cast(Inputs, NoiseMarginalisedInputs(inputs, noise, rng))


class NoiseMarginalisedInputs:
    """The coordinates that are not noise, as inputs of their own; points u (n, k) become x (n, d) with noise drawn.

    The same u gets the same noise again: rows of u are known by their bytes, and their noise is made anew from a
    counter, so that nothing large is kept.

    Args:
        inputs: All of x.
        noise: Which coordinates are noise, shape (d,).
        rng: Seeds the noise.
    """

    def __init__(self, inputs: Inputs, noise: NDArray[np.bool_], rng: np.random.Generator) -> None:
        self.dim = int(np.count_nonzero(~noise))
        self._base, self._noise = inputs.base, noise
        self._seed = int(rng.integers(2**63))
        self._numbers: dict[bytes, int] = {}

    @property
    def base(self) -> Distribution:
        """Their distribution."""
        return self

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        """Map u (n, k) to x (n, d), with noise."""
        whole = np.empty((len(u), len(self._noise)))
        whole[:, ~self._noise] = u
        count = len(self._noise) - self.dim
        for row, key in enumerate(map(bytes, np.ascontiguousarray(u))):
            number = self._numbers.setdefault(key, len(self._numbers))
            whole[row, self._noise] = np.random.default_rng((self._seed, number)).standard_normal(count)
        return self._base.from_standard_normal(whole)

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        """Map x (n, d) to u (n, k)."""
        return self._base.to_standard_normal(x)[:, ~self._noise]

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw points x, shape (n, d)."""
        return self.from_standard_normal(rng.standard_normal((n, self.dim)))

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Return the log density of x (n, d), noise included, shape (n,)."""
        return self._base.log_prob(x)
