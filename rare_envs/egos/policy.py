"""Policies as drivers: objects with the `predict` of Stable-Baselines3, and the check of their spaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from rare_envs.control.actions import DISCRETE_ACTIONS, IDLE, META_ACTIONS, to_physical
from rare_envs.devices import move_to
from rare_envs.egos.dense_policies import DenseInference, find_inference
from rare_envs.egos.errors import refuse_ego
from rare_envs.egos.inference import PolicyQuery, query_policy
from rare_envs.egos.needs import RULE_BASED_EGOS, EgoNeeds, ModuleEgo, WorldEgo, find_rule_based, resolve
from rare_envs.egos.wrappers import find_frame_stacking, wrap_policy
from rare_envs.sensors.kinds import map_kinds
from rare_envs.simulation.background import Background, TrafficBackground
from rare_envs.simulation.observation import observe
from rare_envs.simulation.rollout import Driver
from rare_envs.simulation.world import World

if TYPE_CHECKING:
    from rare_envs.simulation.episode import Episode


@dataclass(frozen=True)
class PolicyDriver:
    """Any object with Stable-Baselines3's `predict`, called on the whole batch."""

    policy: Any
    observation: str = "features"
    """What it observes."""
    action: str = "continuous"
    """What its actions are."""
    stride: int = 1
    """Ticks from one query to the next; in between meta-actions go on."""
    failed_rows: dict[int, str] | None = None
    """Takes the rows on which the policy fails, with the reason; None if such a failure is raised."""

    def act(self, episode: Episode, memory: Any) -> tuple[Tensor, Any]:
        """Observe, and query the policy for its mean action; a recurrent policy's hidden state is the memory.

        No episode shows a policy what comes after its collision, so those rows are shown what another row sees, and
        their actions are ignored. The same holds for rows on which it failed before.
        """
        state, device = episode.state, episode.state.x.device
        batch = len(state.x)
        hidden, tick, policy = (None, 0, find_inference(self.policy)) if memory is None else memory
        if tick % self.stride:
            return torch.full((batch,), IDLE, device=device), (hidden, tick + 1, policy)
        seen = observe(episode, self.observation)
        over = episode.collided.cpu()
        if self.failed_rows:
            over = over.clone()
            over[list(self.failed_rows)] = True
        observation = map_kinds(lambda part: _replace_rows(part.cpu(), over).numpy(force=True), seen)
        start = np.full(batch, memory is None)
        actions, hidden = query_policy(
            policy, self.action, PolicyQuery(observation, hidden, start, over), self.failed_rows
        )
        actions = actions.to(state.x) if actions.is_floating_point() else actions.to(device)
        return actions, (hidden, tick + 1, policy)


@dataclass(frozen=True, eq=False)
class DevicePolicyDriver:
    """A policy with continuous actions that answers where the observations are: nothing of a tick goes to the CPU."""

    policy: DenseInference | ModuleEgo
    observation: str = "features"
    """What it observes."""

    @property
    def recordable(self) -> bool:
        """Whether its answers depend on the observations alone: those of layers that were copied, not of a module."""
        return isinstance(self.policy, DenseInference)

    def act(self, episode: Episode, memory: Any) -> tuple[Tensor, Any]:
        """Observe and decide; an ego whose policy does not answer by finite numbers is NaN from then on."""
        actions = self.policy.decide(observe(episode, self.observation))
        actions = actions.to(episode.state.x.device)  # a module has its own
        return to_physical(actions, len(episode.collided), episode.collided).to(episode.state.x), memory


def find_device_driver(driver: Driver, device: torch.device, before: Driver | None = None) -> Driver | None:
    """Return what decides as a driver does on a GPU, with its present weights; None if only the CPU can query it.

    Args:
        driver: The ego.
        device: The GPU.
        before: What this returned before, to be returned again if nothing has changed.
    """
    if not isinstance(driver, PolicyDriver):
        return driver
    policy = find_inference(driver.policy)
    if driver.action != "continuous" or not isinstance(policy, DenseInference | ModuleEgo):
        return None
    placed = move_to(device, policy) if isinstance(policy, DenseInference) else policy
    if isinstance(before, DevicePolicyDriver) and isinstance(placed, DenseInference) and placed.equals(before.policy):
        return before
    return DevicePolicyDriver(placed, driver.observation)


def _replace_rows(observation: Tensor, rows: Tensor) -> Tensor:
    """Return an observation in which some rows are replaced by the first other row, or by zeros if there is none."""
    replaced = rows.numpy(force=True)
    if not replaced.any():
        return observation
    wide = rows.view(-1, *[1] * (observation.ndim - 1))
    if replaced.all():
        return observation.masked_fill(wide, 0)
    return torch.where(wide, observation[int(replaced.argmin())], observation)


def as_driver(ego: Any, world: World, needs: EgoNeeds | None = None) -> Driver:
    """Return the Driver that an ego stands for in a world.

    Args:
        ego: "idm", "human", a `Driver`, an object with `predict`, a `rare_envs.egos.needs.WorldEgo`, or a function or
            torch module from observations to actions.
        world: The world; what `resolve` says that the ego needs it has.
        needs: The answer of `resolve`, if it is known already; None resolves the ego here.

    Example:
        >>> from rare_envs.scenarios.cut_in import CUT_IN
        >>> type(as_driver("idm", World(CUT_IN))).__name__
        'IDM'

    Raises:
        ValueError: If it is none of these, or its spaces do not fit.
    """
    ego = find_rule_based(ego)
    if isinstance(ego, str | type):  # a class has the attributes of its egos
        refuse_ego(ego, known=tuple(RULE_BASED_EGOS))
    if isinstance(ego, WorldEgo):
        return ego.in_world(world)
    needs = needs or resolve(ego, world.scenario.vehicles)
    if needs.queries_policy:
        check_spaces(ego, world.observation_space, world.clock.action, needs.observation)
        if needs.dt is not None and needs.dt != world.clock.dt:
            raise ValueError(
                f"Expected dt={needs.dt:g} s, which this ego remembers pictures by, got {world.clock.dt:g} s."
            )
        policy = wrap_policy(ego, world.observation_space)
        return PolicyDriver(policy, world.sensing.observation, world.clock.action, world.clock.stride)
    if isinstance(ego, Background | TrafficBackground):
        raise ValueError("These drivers drive the traffic around an ego; as an ego take agents.LearnedEgo(driver).")
    if callable(getattr(ego, "act", None)):  # anybody's object
        driver: Driver = ego
        return driver
    refuse_ego(ego, known=tuple(RULE_BASED_EGOS))


def check_spaces(ego: Any, expected: spaces.Space[Any], action: str = "continuous", declared: str = "features") -> None:
    """Refuse an ego that was made for other observations or actions; one that declares none is accepted.

    Bounds may differ: HighwayEnv declares none for the observations that are clipped here as there.

    Args:
        ego: The ego.
        expected: The environment's observations.
        action: Kind of the environment's actions.
        declared: Kind of observation that the ego's space tells, for the message.
    """
    observed = getattr(ego, "observation_space", None)  # a Stable-Baselines3 model, or anybody's object
    if observed is not None and find_frame_stacking(expected, observed) is None:
        which = "another observation" if declared == "features" else f"observation={declared!r}"
        raise ValueError(
            f"The ego expects observations {observed}, the environment gives {expected}; "
            f"train it in this environment or choose {which}."
        )
    acted = getattr(ego, "action_space", None)  # likewise
    if acted is not None and action == "meta":
        if not (isinstance(acted, spaces.Discrete) and int(acted.n) == len(META_ACTIONS)):
            raise ValueError(
                f"The ego acts in {acted}, the environment takes Discrete({len(META_ACTIONS)}) "
                f"({', '.join(META_ACTIONS)}); leave action='meta' out for an ego that accelerates and steers."
            )
        return
    discrete = isinstance(acted, spaces.Discrete) and int(acted.n) == len(DISCRETE_ACTIONS)
    if acted is not None and action == "discrete" and not discrete:
        raise ValueError(
            f"The ego acts in {acted}, the environment takes Discrete({len(DISCRETE_ACTIONS)}) (five accelerations); "
            "leave action='discrete' out for an ego that accelerates and steers."
        )
    several = isinstance(acted, spaces.MultiDiscrete | spaces.MultiBinary)
    shape = getattr(acted, "shape", None)  # whatever it declares
    if acted is not None and not discrete and (several or shape != (2,)):
        raise ValueError(
            f"The ego acts in {acted}, the environment takes Box(-1, 1, (2,)) (acceleration, steering) "
            f"or Discrete({len(DISCRETE_ACTIONS)})."
        )
