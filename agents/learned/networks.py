"""The network of a learned driver, from features to a Gaussian over acceleration and yaw rate, and its noise.

Recorded accelerations and yaw rates, less what 51 features explain, oscillate: their autocorrelation is 0.98 after
0.1 s, 0.7 after 0.5 s, and negative between 1.1 and 3 s. White noise (O'Kelly et al.'s) has none of this, and a
first-order noise of the same smoothness makes a car wander off, because nothing brings it back.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from rare_envs.devices import constant

FEATURE_SIZE = 51
"""Features of `rare_envs.sensors.lidar.FEATURES`."""
HIDDEN_SIZES = (200, 100)
"""Units of the two hidden layers (O'Kelly et al. 2018, section 4)."""
ACTION_SIZE = 2
"""Acceleration and yaw rate."""
HEAD_SIZE = (HIDDEN_SIZES[-1] + 1) * 2 * ACTION_SIZE
"""Weights of the last layer, 404: what a search over drivers perturbs (O'Kelly et al. 2018, section 4)."""
FEATURE_CLIP = 8.0
"""Normalised features are clipped to +-this, so that a scene far from the record cannot saturate every unit."""

HEAD_GAIN, LOG_STD_BIAS = 0.1, -1.0
"""Factor on the first weights of the last layer, and its first biases of log standard deviations: a new network acts
almost alike everywhere, with noise of about a quarter of the recorded spread, from which cloning starts smoothly."""

"""Weights, shape (outputs, inputs), and biases, shape (outputs,)."""


class Scaling(NamedTuple):
    """Means and spreads of recorded driving, by which features and actions are normalised.

    Example:
        >>> scaling = Scaling(torch.zeros(51), torch.ones(51), torch.zeros(2), torch.ones(2))
        >>> Policy(scaling).normalise(torch.full((1, 51), 20.0)).max().item()
        8.0
    """

    feature_mean: Tensor
    """Shape (51,)."""
    feature_std: Tensor
    """Shape (51,); 1 for what is constant."""
    action_mean: Tensor
    """Shape (2,): [m/s^2] and [rad/s]."""
    action_std: Tensor
    """Likewise."""


class Policy(nn.Module):
    """The network: 51-200-100 tanh units, then one linear layer to two means and two log standard deviations.

    O'Kelly et al. have the same sizes with ReLU; on the data that the shipped drivers learned from, tanh overfits less.
    Everything is in normalised units, see `Scaling`.

    Example:
        >>> scaling = Scaling(torch.zeros(51), torch.ones(51), torch.zeros(2), torch.ones(2))
        >>> mean, log_std = Policy(scaling)(torch.zeros(4, 51))
        >>> tuple(mean.shape), bool((log_std < 0.0).all())
        ((4, 2), True)
    """

    def __init__(self, scaling: Scaling, log_std_cap: float = 0.0) -> None:
        """Start with small heads, and a log standard deviation of about -1.3.

        Args:
            scaling: Of features and actions.
            log_std_cap: The log standard deviations approach this smoothly from below. A hard cap would have no
                gradient beyond it, and leave half of the last layer's weights without effect.
        """
        super().__init__()
        self.log_std_cap: Tensor
        self.register_buffer("log_std_cap", torch.tensor(float(log_std_cap)))
        for name, value in scaling._asdict().items():
            self.register_buffer(name, value.detach().float().clone())
        self.first = nn.Linear(FEATURE_SIZE, HIDDEN_SIZES[0])
        self.second = nn.Linear(HIDDEN_SIZES[0], HIDDEN_SIZES[1])
        self.head = nn.Linear(HIDDEN_SIZES[1], 2 * ACTION_SIZE)
        with torch.no_grad():
            self.head.weight.mul_(HEAD_GAIN)
            self.head.bias.zero_()
            self.head.bias[ACTION_SIZE:] = LOG_STD_BIAS

    @property
    def scaling(self) -> Scaling:
        """The normalisation that the weights belong to."""
        return Scaling(*(self.get_buffer(name) for name in Scaling._fields))

    def normalise(self, features: Tensor) -> Tensor:
        """Return features (..., 51), given in SI units, as multiples of their spreads in the record, clipped."""
        scaling = self.scaling
        return ((features - scaling.feature_mean) / scaling.feature_std).clamp(-FEATURE_CLIP, FEATURE_CLIP)

    def trunk(self, features: Tensor) -> Tensor:
        """Return the hidden units (..., 100) of features (..., 51) in SI units."""
        return torch.tanh(self.second(torch.tanh(self.first(self.normalise(features)))))

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return means and log standard deviations (..., 2) of actions (both normalised) for features (..., 51)."""
        return self.split(self.head(self.trunk(features)))

    def split(self, output: Tensor) -> tuple[Tensor, Tensor]:
        """Return the four outputs of the last layer (..., 4) as means and capped log standard deviations (..., 2)."""
        mean, log_std = output[..., :ACTION_SIZE], output[..., ACTION_SIZE:]
        return mean, self.log_std_cap - nn.functional.softplus(self.log_std_cap - log_std)


def head_weights(policy: Policy) -> Tensor:
    """Return the 404 weights of the last layer: for each of the four outputs its 100 weights and its bias.

    Example:
        >>> scaling = Scaling(torch.zeros(51), torch.ones(51), torch.zeros(2), torch.ones(2))
        >>> tuple(head_weights(Policy(scaling)).shape)
        (404,)
    """
    return torch.cat((policy.head.weight, policy.head.bias[:, None]), dim=1).flatten()


def apply_heads(hidden: Tensor, weights: Tensor) -> Tensor:
    """Apply the last layer, with weights of its own for every scenario.

    Args:
        hidden: Hidden units of M vehicles in B scenarios, shape (B, M, 100).
        weights: As `head_weights` has them, shape (B, 404).

    Returns:
        Outputs, shape (B, M, 4).
    """
    layer = weights.view(len(weights), 2 * ACTION_SIZE, HIDDEN_SIZES[-1] + 1)
    return torch.baddbmm(layer[:, None, :, -1], hidden, layer[:, :, :-1].mT)


def is_plain(policy: Policy) -> bool:
    """Return whether a network does what a `Policy` does: its class and layers, nothing put in their place.

    Example:
        >>> policy = Policy(Scaling(torch.zeros(51), torch.ones(51), torch.zeros(2), torch.ones(2)))
        >>> plain = is_plain(policy)
        >>> policy.head.register_forward_hook(print) and plain, is_plain(policy)
        (True, False)
    """
    if type(policy) is not Policy:
        return False
    modules = (policy, policy.first, policy.second, policy.head)
    changed = any(vars(module).keys() & {"forward", "trunk", "normalise", "split"} for module in modules)
    hooked = any(module._forward_hooks or module._forward_pre_hooks for module in modules)
    return all(type(layer) is nn.Linear for layer in modules[1:]) and not (changed or hooked)


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
