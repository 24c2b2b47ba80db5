"""Training an ego on with the failures that an evaluation found, mixed into ordinary scenarios."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from rare_envs.arrays import FloatArray
from rare_envs.distributions.space import Distribution, ScenarioSpace

FAILURE_SHARE = 0.25
"""Share of episodes that begin in a failure."""


@dataclass(frozen=True, eq=False)
class ScenariosWithFailures:
    """Distribution to train in: with probability `share` one of the failures, otherwise a draw from the base.

    It draws only: training needs no density, and the failures have none.

    Example:
        >>> from rare_envs.distributions.product import NoiseDistribution
        >>> mixed = ScenariosWithFailures(NoiseDistribution(2), np.full((1, 2), 9.0), share=0.5)
        >>> x = mixed.sample(1000, np.random.default_rng(0))
        >>> x.shape, int((x == 9.0).all(axis=1).sum())
        ((1000, 2), 519)
    """

    base: Distribution
    """Of ordinary scenarios."""
    failures: FloatArray
    """Each as likely as any other, shape (k, d)."""
    share: float
    """Of failures among the draws."""

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw scenarios, shape (n, d)."""
        x = np.array(self.base.sample(n, rng))
        chosen = rng.random(n) < self.share
        x[chosen] = self.failures[rng.integers(0, len(self.failures), int(chosen.sum()))]
        return x


@dataclass(frozen=True, eq=False)
class Retraining:
    """What `train_ego` goes on from: an ego that it trained before, and scenarios in which that ego failed.

    Raises:
        ValueError: There is no failure, they are no table of finite numbers, or the share is not between 0 and 1.

    Example:
        >>> Retraining(Path("ego.zip"), np.zeros((3, 6)), share=0.25)
        Retraining(ego=PosixPath('ego.zip'), share=0.25)
        >>> Retraining(Path("ego.zip"), np.zeros((0, 6)))
        Traceback (most recent call last):
        ...
        ValueError: Expected failures of shape (k, d) with k >= 1 and finite values, got shape (0, 6).
    """

    ego: Path
    """The `.zip` of the ego."""
    failures: FloatArray = field(repr=False)
    """Scenarios in the order of x of the environment, shape (k, d)."""
    share: float = FAILURE_SHARE
    """Share of episodes that begin in one of the failures, drawn uniformly; the others begin in ordinary scenarios."""

    def __post_init__(self) -> None:
        x = np.asarray(self.failures, dtype=np.float64)
        if x.ndim != 2 or not len(x) or not np.isfinite(x).all():
            raise ValueError(
                f"Expected failures of shape (k, d) with k >= 1 and finite values, got shape {np.shape(self.failures)}."
            )
        if not (math.isfinite(self.share) and 0.0 < self.share < 1.0):
            raise ValueError(f"Expected a share of failures above 0 and below 1, got {self.share!r}.")
        object.__setattr__(self, "failures", x)

    def arguments(self) -> dict[str, str]:
        """Return what a checkpoint notes of it: a resumed training has to go on from the same ego and failures.

        Raises:
            OSError: The ego's file cannot be read.
        """
        if not self.ego.is_file():
            raise FileNotFoundError(f"No ego at {str(self.ego)!r}.")
        ego, failures = (
            hashlib.sha256(content).hexdigest() for content in (self.ego.read_bytes(), self.failures.tobytes())
        )
        return {"retrained": ego, "failures": failures, "failure_share": str(self.share)}

    def mix(self, space: ScenarioSpace) -> ScenarioSpace:
        """Return the space of an environment with the failures among its draws.

        Raises:
            ValueError: The failures are not of this space.
        """
        mixed = ScenariosWithFailures(space.base, space.validate(self.failures), self.share)
        return replace(space, base=cast(Distribution, mixed))  # an environment only draws


def check_retrainable(saved: Any, algo: str, env: Any) -> None:
    """Raise a ValueError if an ego cannot be trained on in an environment.

    Args:
        saved: The ego, an `agents.SavedEgo`.
        algo: Algorithm to train it by.
        env: The environment, a `training.sb3_vec_env`.

    Raises:
        ValueError: It was trained by another algorithm, behind `VecNormalize`, or with other spaces.
    """
    name = repr(str(saved.path))
    if saved.algorithm != algo:
        raise ValueError(f"Expected an ego trained by {algo}, got {name}, trained by {saved.algorithm}.")
    if saved.statistics is not None:
        raise ValueError(f"Cannot train {name} on: it was trained behind VecNormalize, train-ego has none.")
    for what in ("observation_space", "action_space"):
        own, given = getattr(saved.model, what), getattr(env, what)  # both have these two
        if own != given:
            raise ValueError(f"Cannot train {name} on: its {what} is {own}, that of the environment is {given}.")


def restore_parameters(model: Any, saved: Any) -> None:
    """Give a new model the networks, the optimisers and the entropy coefficient of a saved ego.

    Args:
        model: Of Stable-Baselines3, with networks of the same sizes.
        saved: The ego, an `agents.SavedEgo`.

    Raises:
        ValueError: The file has other networks, or nothing of its training.
    """
    from stable_baselines3.common.save_util import load_from_zip_file, recursive_getattr

    try:
        # settings, which hold pickles, are not opened; tensors are read as tensors only
        _, parameters, variables = load_from_zip_file(saved.path, device="cpu", load_data=False)
        model.set_parameters(parameters, exact_match=True, device="cpu")
        for name, value in (variables or {}).items():
            recursive_getattr(model, name).data.copy_(value)
    except (KeyError, RuntimeError, ValueError, AttributeError, TypeError) as error:
        words = str(error).partition("\n")[0]
        raise ValueError(
            f"Cannot train {str(saved.path)!r} on: it has not all that a training needs: {words}"
        ) from error


def continue_settings(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments of an algorithm that goes on: it explores as at the end of a training and learns at once.

    Example:
        >>> continue_settings({"learning_starts": 2560, "exploration_final_eps": 0.02, "gamma": 0.98})
        {'learning_starts': 0, 'exploration_final_eps': 0.02, 'gamma': 0.98, 'exploration_initial_eps': 0.02}
    """
    changed = dict(arguments)
    if "learning_starts" in changed:
        changed["learning_starts"] = 0
    if "exploration_final_eps" in changed:
        changed["exploration_initial_eps"] = changed["exploration_final_eps"]
    return changed
