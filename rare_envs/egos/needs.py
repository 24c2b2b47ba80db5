"""Needs of egos: `resolve` reads once what an ego needs and says about itself; Protocols name what it may have."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

from gymnasium import spaces

from rare_envs.control.idm import IDM
from rare_envs.egos.human import HumanEgo
from rare_envs.egos.plain_callables import wrap_callable
from rare_envs.egos.validation import is_policy
from rare_envs.sensors.kinds import OBSERVATIONS, read_kinds
from rare_envs.simulation.ego_interface import EgoNeeds
from rare_envs.simulation.observation import observation_space
from rare_envs.simulation.rollout import Driver
from rare_envs.simulation.world import World

RULE_BASED_EGOS: Mapping[str, Any] = MappingProxyType({"idm": IDM(), "human": HumanEgo()})
"""Egos that are known by a name."""


@runtime_checkable
class PerceivingDriver(Driver, Protocol):
    """A driver that reads `Episode.perception` by itself, whatever the environment observes."""

    @property
    def needs_lidar(self) -> bool:
        """Whether it reads lidar features."""


@runtime_checkable
class WorldEgo(Protocol):
    """An ego that becomes a driver only in a world, with noise of its own, such as a human driver."""

    def noise_columns(self, world: World) -> int:
        """Return how many standard normal columns of x are its noise in a world."""

    def in_world(self, world: World) -> Driver:
        """Return the driver that it is in a world.

        Raises:
            ValueError: The ego does not fit the world.
        """


@runtime_checkable
class WrappedEgo(WorldEgo, Protocol):
    """An ego behind something that stands between it and its world, such as an imperfect stack.

    Example:
        >>> from rare_envs.control.idm import IDM
        >>> class SameAsEver:
        ...     ego = "idm"
        ...     def noise_columns(self, world):
        ...         return 0
        ...     def in_world(self, world):
        ...         return IDM()
        >>> isinstance(SameAsEver(), WrappedEgo)
        True
    """

    @property
    def ego(self) -> Any:
        """The ego behind it."""


def resolve(ego: Any, vehicles: int = 1) -> EgoNeeds:
    """Return what an ego needs of its world.

    An ego that wraps another one needs what that one needs, and noise columns of its own.

    Args:
        ego: "idm", "human", a `Driver`, an object with `predict`, a `WorldEgo`, or a function or torch module from
            observations to actions.
        vehicles: Of the scenario, which tell the features' space from that of the lidar.

    Example:
        >>> from gymnasium import spaces
        >>> class Policy:
        ...     observation_space = observation_space(1, "lidar")
        ...     deterministic = False
        ...     def predict(self, observation, state=None, episode_start=None, deterministic=True): ...
        >>> needs = resolve(Policy(), vehicles=3)
        >>> needs.observation, needs.varies, needs.queries_policy
        ('lidar', True, True)
    """
    ego = find_rule_based(ego)
    if isinstance(ego, WrappedEgo):
        inner = resolve(ego.ego, vehicles)
        return EgoNeeds(
            inner.observation, inner.lidar, inner.dt, inner.action_space, inner.queries_policy, inner.varies, noise=ego
        )
    if isinstance(ego, WorldEgo):
        return EgoNeeds(noise=ego)
    # The ego may be anybody's object, such as a Stable-Baselines3 model: it may declare these or not.
    lidar = isinstance(ego, PerceivingDriver) and ego.needs_lidar
    return EgoNeeds(
        observation=observation_for(ego, vehicles),
        lidar=lidar,
        dt=getattr(ego, "dt", None),
        action_space=getattr(ego, "action_space", None),
        queries_policy=is_policy(ego) and not lidar,
        varies=getattr(ego, "deterministic", None) is False,
    )


def find_rule_based(ego: Any) -> Any:
    """Return the driver that "idm" or "human" names, a policy for a plain function, and any other ego as it is."""
    return RULE_BASED_EGOS.get(ego, ego) if isinstance(ego, str) else wrap_callable(ego)


def observation_for(ego: Any, vehicles: int = 1) -> str:
    """Return what to show an ego where nobody says: what its space tells, else "features".

    Args:
        ego: A `Dict` names the kinds, such as "camera+speed"; the space of "lidar" is known by its shape.
        vehicles: Of the scenario, whose features may have that shape too.
    """
    space = getattr(ego, "observation_space", None)  # anybody's object
    if space == observation_space(vehicles, "lidar") != observation_space(vehicles, "features"):
        return "lidar"
    names = set(space.spaces) if isinstance(space, spaces.Dict) else set[str]()
    return read_kinds(sorted(names)) if names and names <= set(OBSERVATIONS) else "features"
