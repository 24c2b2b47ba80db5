"""EgoNeeds: what an ego needs of its world and of x, known before world and space are built."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from rare_envs.simulation.world import World


class NoiseSource(Protocol):
    """Something with noise of its own, which becomes part of x."""

    def noise_columns(self, world: World) -> int:
        """Return how many standard normal columns of x are its noise in a world."""


@dataclass(frozen=True)
class EgoNeeds:
    """Needs of an ego, and its statements about itself; `rare_envs.egos.needs.resolve` finds it out.

    Example:
        >>> EgoNeeds().observation
        'features'
    """

    observations: tuple[str, ...] = ("features",)
    """Kinds of observation that its space fits, each as `rare_envs.sensors.kinds.read_kinds` writes it; one where it
    declares none."""
    lidar: bool = False
    """Whether it reads `Episode.perception` by itself, whatever is observed."""
    dt: float | None = None
    """The tick [s] that it was made for; None for any."""
    action_space: Any = None
    """The space of its actions, as it declares it; None if it does not."""
    queries_policy: bool = False
    """Whether a policy with `predict` decides, be it behind other parts of the ego."""
    varies: bool = False
    """Whether it says that its answers differ from run to run, by randomness that is not part of x."""
    noise: NoiseSource | None = None
    """Its part that has noise in x; None without one."""
    observation_space: Any = None
    """The space of its observations, as it declares it; None if it does not."""

    @property
    def observation(self) -> str:
        """The first kind of observation that fits, "features" if none does."""
        return self.observations[0] if self.observations else "features"

    def noise_columns(self, world: World) -> int:
        """Return how many columns of x are its own noise, the last ones."""
        return 0 if self.noise is None else self.noise.noise_columns(world)
