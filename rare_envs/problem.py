"""DrivingProblem: a scenario and an ego as a function f(x), in the shape that samplers expect."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from rare_envs.actions import DISCRETE_ACTIONS, META_ACTIONS
from rare_envs.background import Background
from rare_envs.crashes import KINDS, Crash
from rare_envs.drivers import IDM, Driver, PolicyDriver
from rare_envs.faults import reason_of
from rare_envs.mixed import kinds_of
from rare_envs.observation import space_of_observations
from rare_envs.policies import fitted, frames_of, observation_for
from rare_envs.rollout import rollout
from rare_envs.setup import find_scenario, set_up, with_noise
from rare_envs.space import Distribution, ScenarioSpace
from rare_envs.world import World

RULE_TILE = 16384
"""Rollouts that a rule-based ego drives at once: where eager torch is fastest."""
POLICY_TILE = 4096
"""Likewise with a policy; fixed, because matrix products round differently by batch size."""
LIDAR_TILE = 512
"""Likewise where vehicles look, or whole episodes are kept: small enough for what is needed to stay in the cache."""

CAMERA_TILE = 128
"""Likewise with a policy that sees pictures: its layers' values for all of them have to fit into memory."""


AMBIGUOUS = (
    "the ego's actions 0 to 4 were taken as five accelerations; one that was trained in HighwayEnv needs "
    "action='meta' (--action meta)"
)
"""HighwayEnv's meta-actions and our discrete ones are both numbers from 0 to 4: no space tells them apart."""


class AmbiguousActions(UserWarning):
    """An ego's actions can be taken in two ways."""


class DrivingProblem:
    """P[f(X) <= gamma] for an ego in a scenario; fits `samplers.Problem`.

    f(x) is the safety measure of one rollout from scenario parameters x: -1 if the ego collides, else the least time
    to collision [s] (capped at 10 s). It is a deterministic function of x.

    Attributes:
        env_id: The environment's id.
        ego: What was given.
        world: The simulation.
        driver: The ego as a Driver.
        space: Names, units, bounds and base distribution of x.
        varies: Whether the ego answers differently from run to run, by randomness that is not part of x: an attribute
            `deterministic` of it that is False says so. Then p is over that randomness as well, outcomes count as they
            fell, and failures may not replay.
    """

    def __init__(
        self,
        env_id: str,
        ego: Any = "idm",
        measure: Any = "ttc",
        base: Any = None,
        noise: bool | str = True,
        **make_kwargs: Any,
    ) -> None:
        """Check everything that can be checked before a simulation.

        Args:
            env_id: For example "rare_envs/CutIn-v0".
            ego: "idm", a `Driver`, or an object with Stable-Baselines3's `predict`, called on whole batches.
            measure: The safety measure: a name, an object or a function, see `rare_envs.measures.find_measure`.
            base: Base distribution of x; None takes the environment's default ("us101").
            noise: What becomes of the randomness of learned drivers: True, it is part of x, standard normal columns
                behind the others; "fixed", one sequence for all x, so that p is conditional on it; False, mean
                actions. Scripts and most egos have none (policies act by their means), so there the three agree; the
                noise of an ego behind a stack (`noisy:EGO`) goes with it.
            **make_kwargs: Further keyword arguments of `gym.make` for this id. Without an `observation` an ego whose
                `observation_space` is a `Dict` is shown what its names ask for, one whose space is that of the lidar
                this, another "features".

        Raises:
            ValueError: If an argument is invalid or the ego's spaces are not the environment's.
        """
        self.env_id = env_id
        self.ego = ego
        self.world: World
        self.space: ScenarioSpace
        vehicles = find_scenario(env_id).vehicles
        with _told(ego):
            make_kwargs["observation"] = make_kwargs.get("observation") or observation_for(ego, vehicles)
        self.world, self.space = set_up(env_id, measure=measure, base=base, noise=noise, **make_kwargs)
        with _told(ego):
            self.driver = as_driver(ego, self.world)
            self.varies: bool = getattr(ego, "deterministic", None) is False
        for note in self.notes:
            warnings.warn(note, AmbiguousActions, stacklevel=2)
        self.space = with_noise(self.space, "ego_noise", getattr(self.driver, "columns", 0))
        if getattr(self.driver, "sees", False):
            self.world = replace(self.world, lidar=True)

    @property
    def dim(self) -> int:
        """Number of scenario parameters."""
        return self.space.dim

    @property
    def notes(self) -> tuple[str, ...]:
        """What could not be checked and may be meant otherwise; an `AmbiguousActions` warning has said it."""
        meant = self.world.action == "continuous" and "kinematics" in kinds_of(self.world.observation)
        return (AMBIGUOUS,) if meant and isinstance(getattr(self.ego, "action_space", None), spaces.Discrete) else ()

    @property
    def given(self) -> str:
        """What p is conditional on, in words for `samplers.Estimate.given`; empty if nothing is held fixed."""
        fixed = ["the ego's own noise is not part of x, so that failures may not replay"] if self.varies else []
        if self.world.noise != "fixed":
            return ", ".join(fixed)
        if hasattr(self.driver, "columns"):
            fixed.append("the ego's noise is one fixed sequence")
        if self.world.drivers is not None and self.world.drivers.noisy:
            fixed.append("the drivers' noise is one fixed sequence")
        if self.world.weather:
            fixed.append("the camera's noise is one fixed pattern of each tick")
        return ", ".join(fixed)

    @property
    def base(self) -> Distribution:
        """Distribution of x in ordinary traffic."""
        return self.space.base

    def evaluate(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Simulate.

        Args:
            x: Scenario parameters, shape (n, d).

        Returns:
            Safety measures, shape (n,).

        Raises:
            ValueError: If x has the wrong shape, is NaN or outside the physical box, or if the policy or the measure
                returns NaN.
        """
        return self._simulated(x, None)

    def attempt(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], dict[int, str]]:
        """Simulate, and let rows go on which the policy fails.

        Args:
            x: Scenario parameters, shape (n, d).

        Returns:
            Safety measures, shape (n,), NaN in rows that are lost, and the reasons by row.

        Raises:
            Exception: A policy with a memory has failed on the batch, which may be the fault of any row.
        """
        lost: dict[int, str] = {}
        f = self._simulated(x, lost)
        f[list(lost)] = np.nan
        return f, lost

    def crashes(self, x: NDArray[np.float64]) -> Crash:
        """Simulate again and tell what kind of crash each scenario ends in.

        Args:
            x: Scenario parameters, shape (n, d).

        Returns:
            Who ran into whom, how fast and how bad that is; `rare_envs.crashes.KINDS` has the words for the kinds. Of
            kind "others" are collisions between other vehicles in episodes in which the ego has none.

        Raises:
            ValueError: If x has the wrong shape, is NaN or outside the physical box, or if the policy returns NaN.
        """
        x = self.space.validate(np.atleast_2d(x))
        world, found = replace(self.world, measure="ttc", witnessed=True), []
        with torch.inference_mode():
            for first in range(0, len(x), self.tile):
                rows = torch.from_numpy(x[first : first + self.tile]).float()
                seen = rollout(world, self.driver, rows).witness
                assert seen is not None
                found.append(seen.crash)
        return Crash(*(torch.cat(parts) for parts in zip(*found, strict=True)))

    def crash_kinds(self, x: NDArray[np.float64]) -> list[str]:
        """Words for the kinds of crash that scenarios x (n, d) end in, such as "rear_end"; see `crashes`."""
        return [KINDS[kind] for kind in self.crashes(x).kind]

    @property
    def tile(self) -> int:
        """Rollouts at once: `evaluate` simulates so many rows together, then the next."""
        asked = getattr(self.driver, "inner", self.driver)
        if isinstance(asked, PolicyDriver) and "camera" in kinds_of(self.world.observation):
            return CAMERA_TILE
        if self.world.sees or self.world.recorded:
            return LIDAR_TILE
        return POLICY_TILE if isinstance(self.driver, PolicyDriver) else RULE_TILE

    def _simulated(self, x: NDArray[np.float64], lost: dict[int, str] | None) -> NDArray[np.float64]:
        x = self.space.validate(np.atleast_2d(x))
        tile = self.tile
        f = np.empty(len(x))
        with torch.inference_mode():
            for first in range(0, len(x), tile):
                rows = torch.from_numpy(x[first : first + tile]).float()
                driver, mine = self.driver, dict[int, str]()
                if lost is not None and isinstance(driver, PolicyDriver):
                    driver = replace(driver, lost=mine)
                f[first : first + tile] = rollout(self.world, driver, rows).f.numpy()
                if lost is not None:
                    lost.update({first + row: reason for row, reason in mine.items()})
        for row in np.flatnonzero(np.isnan(f)):
            if lost is None:
                named = {name: value for name, value in self.space.named(x[row]).items() if np.size(value) == 1}
                raise ValueError(f"The measure {self.world.measure!r} gave NaN, first at row {row}: {named}.")
            lost.setdefault(int(row), "the measure gave NaN")
        return f


@contextmanager
def _told(ego: Any) -> Iterator[None]:
    """Turn whatever happens when an ego is asked about itself into a ValueError: it is the user's."""
    try:
        yield
    except ValueError:
        raise
    except Exception as error:
        raise ValueError(f"An ego of class {type(ego).__name__} cannot be used: {reason_of(error)}") from error


def as_driver(ego: Any, world: World) -> Driver:
    """The Driver that an ego stands for.

    Raises:
        ValueError: If it is neither "idm", nor a Driver, nor an object with `predict` whose spaces fit.
    """
    if isinstance(ego, str):
        if ego == "idm":
            return IDM()
        raise ValueError(
            f"Unknown ego {ego!r}; expected 'idm' or an object. Names and files become objects by "
            f"agents.load_ego({ego!r})."
        )
    if isinstance(ego, type):
        raise ValueError(f"Expected an ego, got the class {ego.__name__}; make or train one of it first.")
    if callable(getattr(ego, "in_world", None)):
        made: Driver = ego.in_world(world)
        return made
    if getattr(ego, "sees", False):  # a Driver that looks by itself, whatever the environment observes
        looking: Driver = ego
        return looking
    if callable(getattr(ego, "predict", None)):
        expected = space_of_observations(world)
        check_spaces(ego, expected, world.action)
        tick = getattr(ego, "dt", None)
        if tick is not None and tick != world.dt:
            raise ValueError(f"Expected dt={tick:g} s, which this ego remembers pictures by, got {world.dt:g} s.")
        return PolicyDriver(fitted(ego, expected), world.observation, world.action, world.stride)
    if isinstance(ego, Background):
        raise ValueError("These drivers drive the traffic around an ego; as an ego take agents.LearnedEgo(driver).")
    if callable(getattr(ego, "act", None)):
        driver: Driver = ego
        return driver
    raise ValueError(f"Expected an ego with a method predict(observation, ...), got {type(ego).__name__}.")


def check_spaces(ego: Any, expected: spaces.Space[Any], action: str = "continuous") -> None:
    """Refuse an ego that was made for other observations or actions; one that does not tell is taken at its word.

    Bounds may differ: HighwayEnv declares none for the observations that are clipped here as there.

    Raises:
        ValueError: If its `observation_space` or `action_space` does not fit.
    """
    observed = getattr(ego, "observation_space", None)
    if observed is not None and frames_of(expected, observed) is None:
        wanted = observation_for(ego)
        which = "another observation" if wanted == "features" else f"observation={wanted!r}"
        raise ValueError(
            f"The ego expects observations {observed}, the environment gives {expected}; "
            f"train it in this environment or choose {which}."
        )
    acted = getattr(ego, "action_space", None)
    if acted is not None and action == "meta":
        if not (isinstance(acted, spaces.Discrete) and int(acted.n) == len(META_ACTIONS)):
            raise ValueError(
                f"The ego acts in {acted}, the environment takes Discrete({len(META_ACTIONS)}) "
                f"({', '.join(META_ACTIONS)}); leave action='meta' out for an ego that accelerates and steers."
            )
        return
    discrete = isinstance(acted, spaces.Discrete) and int(acted.n) == len(DISCRETE_ACTIONS)
    several = isinstance(acted, spaces.MultiDiscrete | spaces.MultiBinary)
    if acted is not None and not discrete and (several or getattr(acted, "shape", None) != (2,)):
        raise ValueError(
            f"The ego acts in {acted}, the environment takes Box(-1, 1, (2,)) (acceleration, steering) "
            f"or Discrete({len(DISCRETE_ACTIONS)})."
        )
