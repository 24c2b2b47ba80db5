"""The network of a learned driver, its noise, and the distribution of the weights of its last layer.

Recorded accelerations and yaw rates, less what 51 features explain, oscillate: their autocorrelation is 0.98 after
0.1 s, 0.7 after 0.5 s, and negative between 1.1 and 3 s. White noise (O'Kelly et al.'s) has none of this, and a
first-order noise of the same smoothness makes a car wander off, because nothing brings it back.

References:
    O'Kelly, Sinha, Namkoong, Duchi and Tedrake, "Scalable end-to-end autonomous vehicle testing via rare-event
    simulation", NeurIPS 2018, section 4: the layers; xi ~ N(mu0, Sigma0) from an ensemble of drivers, the inverse of
    Sigma0 sparse; the search moves the mean within |mu - mu0|_inf <= 0.01 and leaves Sigma0 as it is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.sparse import coo_array
from torch import Tensor, nn

from rare_envs.devices import constant
from rare_envs.distributions.coordinates import FloatArray

FEATURE_SIZE = 51
"""Features of `rare_envs.sensors.lidar.FEATURES`."""
HIDDEN_SIZES = (200, 100)
"""Units of the two hidden layers."""
ACTION_SIZE = 2
"""Acceleration and yaw rate."""
HEAD_SIZE = (HIDDEN_SIZES[-1] + 1) * 2 * ACTION_SIZE
"""Weights of the last layer, 404: what a search over drivers perturbs."""
FEATURE_CLIP = 8.0
"""Normalised features are clipped to +-this, so that a scene far from the record cannot saturate every unit."""
HEAD_GAIN, LOG_STD_BIAS = 0.1, -1.0
"""Factor on the first weights of the last layer, and its first biases of log standard deviations: a new network acts
almost alike everywhere, with noise of about a quarter of the recorded spread, from which cloning starts smoothly."""
RADIUS = 0.01
"""Largest shift of each mean in a search."""
SYMMETRY = 1e-9
"""Relative difference of mirrored entries that rounding may leave in a precision."""
HEAD_OUTPUTS = ("mean_acceleration", "mean_yaw_rate", "log_std_acceleration", "log_std_yaw_rate")
WEIGHT_NAMES = tuple(f"{output}_{unit}" for output in HEAD_OUTPUTS for unit in (*range(HIDDEN_SIZES[-1]), "bias"))
"""Names of the 404 weights, in the order of `head_weights`: each output's 100 weights, then its bias."""


class Scaling(NamedTuple):
    """Means and spreads of recorded driving, by which features and actions are normalised."""

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
    """

    def __init__(self, scaling: Scaling, log_std_cap: float = 0.0) -> None:
        """Start with small heads; log standard deviations, at first about -1.3, approach their cap from below."""
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
    """Return the 404 weights of the last layer: for each of the four outputs its 100 weights and its bias."""
    return torch.cat((policy.head.weight, policy.head.bias[:, None]), dim=1).flatten()


@dataclass(frozen=True)
class AutoregressiveNoise:
    """Stationary noise with variance 1: noise_t = first noise_{t-1} + second noise_{t-2} + scale fresh_t.

    There is one pair of coefficients for each of the two actions.
    """

    first: tuple[float, float] = (0.0, 0.0)
    """Coefficients of lag 1 of acceleration and of yaw rate; white noise has 0 here and below."""
    second: tuple[float, float] = (0.0, 0.0)
    """Coefficients of lag 2."""
    balanced: bool = False
    """Whether it begins so that what is expected of it adds up to 0: with nothing left of a swing that was under way
    before, which would shift speed and heading for good."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "first", tuple(self.first))  # JSON has lists
        object.__setattr__(self, "second", tuple(self.second))
        if self.balanced and 0.0 in self.second:
            raise ValueError(f"Expected coefficients of lag 2 of a noise that begins balanced, got {self.second}.")
        for a, b in zip(self.first, self.second, strict=True):
            if not (abs(b) < 1.0 and abs(a) < 1.0 - b):
                raise ValueError(f"Expected the coefficients of a stationary noise, got {a} and {b}.")

    @property
    def scale(self) -> tuple[float, float]:
        """Standard deviation of the fresh part, such that the noise has variance 1."""
        a, b = (
            math.sqrt((1 + b) * ((1 - b) ** 2 - a**2) / (1 - b)) for a, b in zip(self.first, self.second, strict=True)
        )
        return a, b

    def begin(self, fresh: Tensor) -> Tensor:
        """Return the values one and two ticks ago (..., 2, 2), stationary or balanced, made of standard normal draws.

        Both have the action first, then two values or draws; balanced noise does not use the second draw.
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
HUMAN_NOISE = AutoregressiveNoise((1.8114489295221357, 1.897944985293789), (-0.8445089033860342, -0.9231163463866358))
"""With the autocorrelation of what cloning leaves unexplained in the record, within 0.03 up to 1 s: first is
2 r cos(w dt), second -r^2, with r = exp(-d dt), w = 1.70 and 1.57 rad/s and decays d = 0.845 and 0.40 /s."""


@dataclass(frozen=True, eq=False)
class WeightDistribution:
    """Normal distribution N(mean, precision^-1), and how far its mean may be moved.

    Cross-entropy takes it as a block as it is: `mean`, `covariance` and `radius` say what it is and how it may move.
    """

    mean: FloatArray = field(repr=False)
    """Shape (d,)."""
    precision: FloatArray = field(repr=False)
    """Inverse covariance, shape (d, d); mostly zeros when a graphical lasso made it."""
    radius: float = RADIUS
    """A search keeps |mu - mean|_inf within this."""

    def __post_init__(self) -> None:
        mean, precision = np.array(self.mean, dtype=np.float64), np.array(self.precision, dtype=np.float64)
        if mean.ndim != 1 or precision.shape != 2 * mean.shape:
            raise ValueError(f"Expected mean (d,) and precision (d, d), got {mean.shape} and {precision.shape}.")
        if not (np.isfinite(mean).all() and np.isfinite(precision).all()):
            raise ValueError("Expected a finite mean and precision, got inf or NaN.")
        if not np.allclose(precision, precision.T, rtol=SYMMETRY, atol=0.0):
            raise ValueError("Expected a symmetric precision, got another one; (precision + precision.T) / 2 is one.")
        if not self.radius >= 0.0:
            raise ValueError(f"Expected radius >= 0, got {self.radius!r}.")
        for name, value in (("mean", mean), ("precision", 0.5 * (precision + precision.T))):
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        self._whitening  # noqa: B018 - positive definite, or an error now rather than at the first draw

    @property
    def dim(self) -> int:
        """Number of weights d."""
        return len(self.mean)

    @cached_property
    def _whitening(self) -> FloatArray:
        """Lower triangular A with A' A = precision, the inverse of the Cholesky factor of the covariance."""
        try:
            reversed_factor = np.linalg.cholesky(self.precision[::-1, ::-1])
        except np.linalg.LinAlgError:
            raise ValueError(
                "Expected a positive definite precision, got one with an eigenvalue of "
                f"{np.linalg.eigvalsh(self.precision)[0]:.3g}; add a small multiple of the unit matrix."
            ) from None
        return np.ascontiguousarray(reversed_factor.T[::-1, ::-1])

    @cached_property
    def cholesky(self) -> FloatArray:
        """Lower triangular L with L L' = covariance, shape (d, d)."""
        return np.asarray(solve_triangular(self._whitening, np.eye(self.dim), lower=True))

    @cached_property
    def covariance(self) -> FloatArray:
        """Shape (d, d)."""
        return np.asarray(self.cholesky @ self.cholesky.T)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""
        return self.from_standard_normal(rng.standard_normal((n, self.dim)))

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, d), shape (n,)."""
        u = self.to_standard_normal(x)
        log_det = float(np.log(np.diag(self._whitening)).sum())
        return np.asarray(log_det - 0.5 * (np.square(u).sum(axis=1) + self.dim * math.log(2.0 * math.pi)))

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Return L^-1 (x - mean) of the rows of x (n, d)."""
        return np.asarray((self._rows(x) - self.mean) @ self._whitening.T)

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Return mean + L u of the rows of u (n, d)."""
        return np.asarray(self.mean + self._rows(u) @ self.cholesky.T)

    def pull_back(self, u: FloatArray, gradients: FloatArray, /) -> FloatArray:
        """Return gradients L' g with respect to u of gradients g with respect to the weights, (n, d)."""
        return np.asarray(self._rows(gradients) @ self.cholesky)

    def _rows(self, x: FloatArray) -> FloatArray:
        """Return points (n, d) as numbers of double precision."""
        x = np.asarray(x, dtype=np.float64)
        if x.ndim != 2 or x.shape[1] != self.dim:
            raise ValueError(f"Expected points of shape (n, {self.dim}), got {x.shape}.")
        return x

    def to_arrays(self) -> dict[str, NDArray[np.generic]]:
        """Return the mean, and rows, columns and values of the non-zero entries of the precision's upper triangle."""
        rows, columns = np.nonzero(np.triu(self.precision))
        index = np.int16 if self.dim <= np.iinfo(np.int16).max else np.int64
        values = self.precision[rows, columns]
        return {"mean": self.mean, "rows": rows.astype(index), "columns": columns.astype(index), "precision": values}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.generic]], radius: float = RADIUS) -> WeightDistribution:
        """Return the distribution of which `to_arrays` gave the arrays."""
        mean, values = arrays["mean"].astype(np.float64), arrays["precision"].astype(np.float64)
        rows, columns = arrays["rows"].astype(np.int64), arrays["columns"].astype(np.int64)
        if (rows > columns).any():
            raise ValueError(f"Expected triplets of the upper triangle of a {len(mean)} x {len(mean)} matrix.")
        upper = coo_array((values, (rows, columns)), (len(mean), len(mean))).toarray()
        precision = upper + np.triu(upper, 1).T
        return cls(mean, precision, radius)
