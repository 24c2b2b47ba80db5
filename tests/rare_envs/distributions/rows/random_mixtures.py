"""Random mixtures in boxes that cut them in every way."""

import numpy as np

from rare_envs.distributions.coordinates import ClosingSpeed, CoordinateKind, Coordinates
from rare_envs.distributions.mixture_conditionals import MixtureConditionals

CLOSING = Coordinates(
    low=[0.0, 0.0, 1.0],
    high=[45.0, 45.0, 150.0],
    kinds=("plain", ClosingSpeed("speed", "gap"), "log"),
    names=("speed", "lead_speed", "gap"),
    order=("speed", "gap", "lead_speed"),
)


def draw_box(rng: np.random.Generator, dim: int, width: float) -> Coordinates:
    """Return a box of plain coordinates and logarithms, about as wide as said, in a random order."""
    kinds: list[CoordinateKind] = ["log" if log else "plain" for log in rng.random(dim) < 0.4]
    names, low = [f"x{j}" for j in range(dim)], rng.uniform(0.5, 1.0, dim)
    return Coordinates(low, low + width * rng.uniform(0.5, 1.0, dim), kinds, names, rng.permutation(names))


def draw_mixture(
    rng: np.random.Generator, coordinates: Coordinates, components: int, correlated: bool
) -> MixtureConditionals:
    """Return a mixture with means in the box and outside."""
    d = coordinates.dim
    centre = coordinates.to_coordinates([0.5 * (coordinates.low + coordinates.high)])[0]
    factors = 0.7 * rng.standard_normal((components, d, d))
    covariances = factors @ factors.transpose(0, 2, 1) + 0.05 * np.eye(d)
    weights = rng.uniform(0.01, 1.0, components)
    means = centre + 2.0 * rng.standard_normal((components, d))
    return MixtureConditionals(
        coordinates, weights / weights.sum(), means, covariances if correlated else covariances * np.eye(d)
    )
