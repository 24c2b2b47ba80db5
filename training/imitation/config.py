"""Settings of a training, with the values that the shipped drivers were trained with."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from agents.learned.networks import HUMAN_NOISE, WHITE_NOISE, AutoregressiveNoise

NOISES = {"human": HUMAN_NOISE, "white": WHITE_NOISE}

ANNEAL = 0.7
"""Share of the training in which the schedules run."""
LAST_RATE = 0.1
"""Share of the learning rates of policy and critic that is left at the end. They fall once the schedules have ended, so
that the policy settles: only that of the last update is kept."""
_RANGES: tuple[tuple[str, Callable[[float], bool], str], ...] = (
    ("updates batch pools scenes horizon age critic_batch ppo_batch", lambda value: value >= 1, ">= 1"),
    ("clone_weight clone_rate policy_rate", lambda value: 0 < value < math.inf, "> 0"),
    ("epochs warm_up weight_decay", lambda value: 0 <= value < math.inf, ">= 0"),
    ("critic_weight collision_weight edge_weight brake_weight", lambda value: 0 <= value < math.inf, ">= 0"),
)
"""Names of settings, the condition on each value, and its text. Schedules of weights are geometric, so not 0."""


@dataclass(frozen=True)
class Config:
    """Settings of the training of a driver; the command line has an option for each.

    Pairs are values at the start and at the end of a schedule. What all trainings have in common is in
    `training.imitation.learner`.

    Raises:
        ValueError: A setting is outside its range.

    Example:
        >>> config = Config(method="gail", updates=1000)
        >>> config.rate_factor(0), round(config.rate_factor(1000), 2)
        (1.0, 0.1)
    """

    method: Literal["gail", "mgail"] = "mgail"
    """Algorithm: mgail (through a model of the traffic) or gail (by policy gradients)."""
    seed: int = 0
    """Random seed; the same seed gives the same weights."""
    updates: int = 1500
    """Number of updates of the policy after behaviour cloning."""
    noise: Literal["human", "white"] = "human"
    """Noise of acceleration and yaw rate: coloured as people's, or white as that of O'Kelly et al."""

    # behaviour cloning, from which both methods start
    epochs: int = 6
    """Epochs of behaviour cloning."""
    batch: int = 512
    """Batch size of behaviour cloning."""
    clone_rate: float = 1e-3
    """Learning rate of behaviour cloning."""
    weight_decay: float = 1e-4
    """Weight decay of behaviour cloning."""

    # rollouts
    pools: int = 5
    """Number of sets of scenes that are driven in turn and continued from update to update, so that late moments are
    visited."""
    scenes: int = 8
    """Number of scenes in a pool."""
    horizon: tuple[int, int] = (15, 30)
    """Number of ticks of a rollout."""
    age: tuple[int, int] = (30, 150)
    """Number of ticks after which a pool is restarted from the record."""

    # costs of the policy
    critic_weight: float = 3.0
    """Weight of the critic in the cost."""
    clone_weight: tuple[float, float] = (0.1, 0.06)
    """Weight of the likelihood of recorded actions, a geometric schedule."""
    collision_weight: float = 16.0
    """Weight of collisions in the cost."""
    edge_weight: float = 16.0
    """Weight of leaving the road in the cost."""
    brake_weight: float = 1.0
    """Weight of hard braking in the cost."""

    # optimisation
    policy_rate: float = 3e-4
    """Learning rate of the policy."""
    critic_batch: int = 512
    """Batch size of the critic."""
    warm_up: int = 30
    """Number of rounds in which only the critic learns."""

    # GAIL, by proximal policy optimisation
    ppo_batch: int = 2048
    """Batch size of each update."""

    def __post_init__(self) -> None:
        if self.method not in ("gail", "mgail"):
            raise ValueError(f"Expected method 'gail' or 'mgail', got {self.method!r}.")
        if self.noise not in NOISES:
            raise ValueError(f"Expected noise 'human' or 'white', got {self.noise!r}.")
        for names, holds, expected in _RANGES:
            for name in names.split():
                value = getattr(self, name)  # a field by its name
                if not all(holds(part) for part in (value if isinstance(value, tuple) else (value,))):
                    raise ValueError(f"Expected {name} {expected}, got {value}.")

    @property
    def colour(self) -> AutoregressiveNoise:
        """The noise."""
        return NOISES[self.noise]

    def rate_factor(self, update: int) -> float:
        """Return the factor of the learning rates at an update: 1, then linearly down to `LAST_RATE`."""
        start = ANNEAL * self.updates
        return 1.0 - (1.0 - LAST_RATE) * min(max((update - start) / max(self.updates - start, 1.0), 0.0), 1.0)

    def share(self, update: int) -> float:
        """Return how far the schedules have come at an update, 0 to 1."""
        return min(update / max(ANNEAL * self.updates, 1.0), 1.0)

    def geometric_schedule(self, ends: tuple[float, float], update: int) -> float:
        """Return the value at an update of a schedule between two ends."""
        first, last = ends
        return float(first * (last / first) ** self.share(update))
