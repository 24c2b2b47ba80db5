"""Needs of egos: `resolve` reads once what an ego needs and says about itself; Protocols name what it may have."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

from rare_envs.control.idm import IDM
from rare_envs.egos.human import HumanEgo
from rare_envs.egos.plain_callables import wrap_callable
from rare_envs.egos.spaces.choice import find_fitting_kinds
from rare_envs.egos.validation import check_predict, is_policy
from rare_envs.simulation.ego_interface import EgoNeeds
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
        vehicles: Of the scenario, whose features have a space for each number of them.

    Example:
        >>> from rare_envs.simulation.observation import observation_space
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
            inner.observations,
            inner.lidar,
            inner.dt,
            inner.action_space,
            inner.queries_policy,
            inner.varies,
            ego,
            inner.observation_space,
        )
    if isinstance(ego, WorldEgo):
        return EgoNeeds(noise=ego)
    if is_policy(ego):
        check_predict(ego)
    # The ego may be anybody's object, such as a Stable-Baselines3 model: it may declare these or not.
    lidar = isinstance(ego, PerceivingDriver) and ego.needs_lidar
    observed = getattr(ego, "observation_space", None)
    return EgoNeeds(
        observations=EgoNeeds.observations if observed is None else find_fitting_kinds(observed, vehicles),
        lidar=lidar,
        dt=getattr(ego, "dt", None),
        action_space=getattr(ego, "action_space", None),
        queries_policy=is_policy(ego) and not lidar,
        varies=getattr(ego, "deterministic", None) is False,
        observation_space=observed,
    )


def find_rule_based(ego: Any) -> Any:
    """Return the driver that "idm" or "human" names, a policy for a plain function, and any other ego as it is."""
    return RULE_BASED_EGOS.get(ego, ego) if isinstance(ego, str) else wrap_callable(ego)
