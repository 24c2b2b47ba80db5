"""Coloured noise of learned drivers: autoregressions of order 2 with unit variance.

Recorded accelerations and yaw rates, less what 51 features explain, oscillate: their autocorrelation is 0.98 after
0.1 s, 0.7 after 0.5 s, and negative between 1.1 and 3 s. White noise (O'Kelly et al.'s) has none of this, and a
first-order noise of the same smoothness makes a car wander off, because nothing brings it back.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from rare_envs.devices import constant


@dataclass(frozen=True)
class AutoregressiveNoise:
    """Stationary noise with variance 1: noise_t = first noise_{t-1} + second noise_{t-2} + scale fresh_t.

    There is one pair of coefficients for each of the two actions.

    Raises:
        ValueError: If a noise is not stationary.

    Example:
        >>> noise = AutoregressiveNoise.from_oscillators(frequency=(1.70, 1.57), damping=(0.845, 0.40))
        >>> [round(value, 4) for value in noise.first]
        [1.8114, 1.8979]
        >>> [round(value, 4) for value in noise.scale]
        [0.1009, 0.062]
    """

    first: tuple[float, float] = (0.0, 0.0)
    """Coefficients of lag 1 of acceleration and of yaw rate; white noise has 0 here and below."""
    second: tuple[float, float] = (0.0, 0.0)
    """Coefficients of lag 2."""
    balanced: bool = False
    """Whether it begins so that what is expected of it adds up to 0: with nothing left of a swing that was under way
    before, which would shift speed and heading for good."""

    def __post_init__(self) -> None:
        if self.balanced and 0.0 in self.second:
            raise ValueError(f"Expected coefficients of lag 2 of a noise that begins balanced, got {self.second}.")
        for a, b in zip(self.first, self.second, strict=True):
            if not (abs(b) < 1.0 and abs(a) < 1.0 - b):
                raise ValueError(f"Expected the coefficients of a stationary noise, got {a} and {b}.")

    @classmethod
    def from_oscillators(
        cls, frequency: tuple[float, float], damping: tuple[float, float], dt: float = 0.1
    ) -> "AutoregressiveNoise":
        """Return the noise with the poles of damped oscillators.

        Args:
            frequency: Of the damped oscillation [rad/s], for acceleration and yaw rate.
            damping: Rate of decay [1/s].
            dt: Tick [s].
        """
        decay = [math.exp(-rate * dt) for rate in damping]
        first = tuple(2.0 * r * math.cos(w * dt) for r, w in zip(decay, frequency, strict=True))
        second = tuple(-r * r for r in decay)
        return cls((first[0], first[1]), (second[0], second[1]))

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "AutoregressiveNoise":
        """Return the noise whose fields were written as JSON, which has lists for tuples."""
        fields: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in values.items()}
        return cls(**fields)

    @property
    def scale(self) -> tuple[float, float]:
        """Standard deviation of the fresh part, such that the noise has variance 1."""
        a, b = (
            math.sqrt((1 + b) * ((1 - b) ** 2 - a**2) / (1 - b)) for a, b in zip(self.first, self.second, strict=True)
        )
        return a, b

    def begin(self, fresh: Tensor) -> Tensor:
        """Return two consecutive values made of independent standard normal ones: stationary, or balanced ones.

        Args:
            fresh: Shape (..., 2, 2): action, then draw; balanced noise does not use the second draw.

        Returns:
            Memory, shape (..., 2, 2): action, then the values one and two ticks ago.
        """
        if self.balanced:  # E[sum of all that follow] = (earlier second + last (first + second)) / (1 - first - second)
            last, (first, second) = fresh[..., 0], (constant(pair, fresh) for pair in (self.first, self.second))
            return torch.stack((last, -last * (first + second) / second), dim=-1)
        correlation = constant(tuple(a / (1 - b) for a, b in zip(self.first, self.second, strict=True)), fresh)
        earlier = fresh[..., 1]
        return torch.stack((correlation * earlier + (1 - correlation.square()).sqrt() * fresh[..., 0], earlier), dim=-1)

    def predict_mean(self, memory: Tensor) -> Tensor:
        """Return the mean of the next value given the last two: (..., 2, 2) -> (..., 2)."""
        return memory[..., 0] * constant(self.first, memory) + memory[..., 1] * constant(self.second, memory)

    def step(self, memory: Tensor, fresh: Tensor) -> tuple[Tensor, Tensor]:
        """Return the next value (..., 2) from standard normal draws (..., 2), and the memory after it."""
        value = self.predict_mean(memory) + constant(self.scale, fresh) * fresh
        return value, torch.stack((value, memory[..., 0]), dim=-1)


WHITE_NOISE = AutoregressiveNoise()
"""Independent from tick to tick."""
HUMAN_NOISE = AutoregressiveNoise.from_oscillators(frequency=(1.70, 1.57), damping=(0.845, 0.40))
"""With the autocorrelation of what cloning leaves unexplained in the record, within 0.03 up to 1 s."""
