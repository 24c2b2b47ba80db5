"""Policies as drivers: the check of their spaces, queries of whole batches, and the rows on which they fail."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from os.path import isfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.control.actions import DISCRETE_ACTIONS, IDLE, META_ACTIONS, read_actions, to_physical
from rare_envs.devices import move_to
from rare_envs.egos.dense_policies import DensePolicy, find_inference
from rare_envs.egos.needs import (
    RULE_BASED_EGOS,
    EgoNeeds,
    ModuleEgo,
    choose_action,
    choose_observation,
    find_picture_size,
    find_rule_based,
    load_named_ego,
    resolve,
    takes_indices,
    wrap_callable,
)
from rare_envs.egos.wrappers import find_frame_stacking, wrap_policy
from rare_envs.plugins import NoAnswer, as_errors, check_name, is_policy, reason_of, refuse_ego
from rare_envs.simulation.background import Background, TrafficBackground
from rare_envs.simulation.observation import map_kinds, observation_space, observe
from rare_envs.simulation.world import Driver, TrafficPolicy, World

if TYPE_CHECKING:
    from rare_envs.scenarios.base import Scenario
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
        x = episode.state.x
        hidden, tick, policy = (None, 0, find_inference(self.policy)) if memory is None else memory
        if tick % self.stride:
            return torch.full((len(x),), IDLE, device=x.device), (hidden, tick + 1, policy)
        over = episode.collided.cpu()
        if self.failed_rows:
            over = over.clone()
            over[list(self.failed_rows)] = True
        seen = observe(episode, self.observation)
        shown = map_kinds(lambda part: _replace_rows(part.cpu(), over).numpy(force=True), seen)
        query = PolicyQuery(shown, hidden, np.full(len(x), memory is None), over)
        actions, hidden = query_policy(policy, self.action, query, self.failed_rows)
        actions = actions.to(x) if actions.is_floating_point() else actions.to(x.device)
        return actions, (hidden, tick + 1, policy)


def _replace_rows(observation: Tensor, rows: Tensor) -> Tensor:
    """Return an observation in which some rows are replaced by the first other row, or by zeros if there is none."""
    replaced = rows.numpy(force=True)
    if not replaced.any():
        return observation
    wide = rows.view(-1, *[1] * (observation.ndim - 1))
    if replaced.all():
        return observation.masked_fill(wide, 0)
    return torch.where(wide, observation[int(replaced.argmin())], observation)


class PolicyQuery(NamedTuple):
    """A query of B rows."""

    observation: Any
    """Shape (B, ...), or several of that kind by name."""
    hidden: Any
    """The policy's memory; None at the start, and always if it has none."""
    start: NDArray[np.bool_]
    """Rows that begin an episode, shape (B,)."""
    over: Tensor
    """Rows whose action does not matter, boolean, shape (B,), on the CPU as all of it."""

    def rows(self, part: slice) -> PolicyQuery:
        """Return some of the rows, for a policy without a memory."""
        return PolicyQuery(map_kinds(lambda one: one[part], self.observation), None, self.start[part], self.over[part])


def query_policy(
    policy: Any, kind: str, query: PolicyQuery, failed_rows: dict[int, str] | None = None
) -> tuple[Tensor, Any]:
    """Return what `read_actions` makes of a policy's actions, "continuous" or "meta", and its memory.

    `failed_rows` takes the rows on which it fails, with the reason; they get the action of a row that does not matter.
    An error is raised if it is None, or on a batch that cannot be split because the policy has a memory.
    """
    if failed_rows is None:
        try:
            action, hidden = _predict(policy, query)
        except NoAnswer:  # its connection may have been lost
            action, hidden = _predict(policy, query)
        return read_actions(kind, action, len(query.start), query.over), hidden
    try:
        actions, hidden, reasons = _query_with_reasons(policy, kind, query)
    except Exception as error:  # the policy is the user's: anything may happen in it
        if query.hidden is not None:
            raise
        hidden, (actions, reasons) = None, _isolate_failing_rows(policy, kind, query, error, len(query.start))
    failed_rows.update(reasons)
    return actions, hidden


def _predict(policy: Any, query: PolicyQuery) -> tuple[Tensor, Any]:
    with np.errstate(), as_errors():  # a policy that sets NumPy's errors sets them for itself
        given = policy.predict(query.observation, state=query.hidden, episode_start=query.start, deterministic=True)
    if not (isinstance(given, tuple | list) and len(given) == 2):
        raise ValueError(f"Expected predict to return actions and memory (None without), got {type(given).__name__}.")
    action, hidden = given
    actions = np.asarray(action, order="C")  # torch takes no view with a negative stride
    if actions.dtype.kind not in "biuf":
        raise ValueError(f"Expected actions as numbers, one or two for each observation, got {reprlib.repr(action)}.")
    return torch.as_tensor(actions), hidden


def _query_with_reasons(policy: Any, kind: str, query: PolicyQuery) -> tuple[Tensor, Any, dict[int, str]]:
    """Return actions, memory, and the reasons of rows that matter with actions that are not finite."""
    (action, hidden), over = _predict(policy, query), query.over
    bad = torch.zeros_like(over)
    if action.is_floating_point() and action.ndim == 2 and len(action) == len(over):
        bad = ~torch.isfinite(action).all(dim=1) & ~over
    reasons = dict.fromkeys(bad.nonzero()[:, 0].tolist(), "NaN or infinite actions")
    return read_actions(kind, action, len(over), over | bad), hidden, reasons


def _isolate_failing_rows(
    policy: Any, kind: str, query: PolicyQuery, error: BaseException, whole: int
) -> tuple[Tensor, dict[int, str]]:
    """Query again after an error, in parts of the `whole` until the rows that fail stand alone.

    These are the rows of one tick: no other tick is driven again. Halves take the fewest queries. If no answer came,
    queries are cheap, but waiting for one that does not come, or for a process that starts again, is not: then the root
    of the whole batch, and after that each row alone. The error is raised if the policy turns out to have a memory.
    """
    n = len(query.start)
    root = math.isqrt(whole) if isinstance(error, NoAnswer) else (n + 1) // 2
    size = root if 1 < root < n else 1
    actions, reasons = list[Tensor](), dict[int, str]()
    for first in range(0, n, size):
        part = query.rows(slice(first, first + size))
        try:
            if n == 1 and isinstance(error, NoAnswer):
                raise error  # it is not waited for once more
            found, hidden, why = _query_with_reasons(policy, kind, part)
        except Exception as raised:  # the policy is the user's: anything may happen in it
            if len(part.start) > 1:
                found, why = _isolate_failing_rows(policy, kind, part, raised, whole)
            else:
                nothing = torch.zeros(1, dtype=torch.int64) if kind == "meta" else torch.zeros(1, 2)
                found, why = read_actions(kind, nothing, 1, torch.ones_like(part.over)), {0: reason_of(raised)}
        else:
            if hidden is not None:
                raise error
        actions.append(found)
        reasons.update({first + row: reason for row, reason in why.items()})
    return torch.cat(actions), reasons


@dataclass(frozen=True, eq=False)
class DevicePolicyDriver:
    """A policy with continuous actions that answers where the observations are: nothing of a tick goes to the CPU."""

    policy: DensePolicy | ModuleEgo
    observation: str = "features"
    """What it observes."""

    @property
    def recordable(self) -> bool:
        """Whether its answers depend on the observations alone: those of layers that were copied, not of a module."""
        return isinstance(self.policy, DensePolicy)

    def act(self, episode: Episode, memory: Any) -> tuple[Tensor, Any]:
        """Observe and decide; an ego whose policy does not answer by finite numbers is NaN from then on."""
        actions = self.policy.decide(observe(episode, self.observation))
        actions = actions.to(episode.state.x.device)  # a module has its own
        return to_physical(actions, len(episode.collided), episode.collided).to(episode.state.x), memory


def find_device_driver(driver: Driver, device: torch.device, before: Driver | None = None) -> Driver | None:
    """Return what decides as a driver on a GPU, `before` if nothing has changed; None if only the CPU can query it."""
    if not isinstance(driver, PolicyDriver):
        return driver
    policy = find_inference(driver.policy)
    if driver.action != "continuous" or not isinstance(policy, DensePolicy | ModuleEgo):
        return None
    placed = move_to(device, policy) if isinstance(policy, DensePolicy) else policy
    if isinstance(before, DevicePolicyDriver) and isinstance(placed, DensePolicy) and placed.equals(before.policy):
        return before
    return DevicePolicyDriver(placed, driver.observation)


def as_driver(ego: Any, world: World, needs: EgoNeeds | None = None) -> Driver:
    """Return the Driver that an ego of any kind, see `egos.needs`, stands for in a world; else a ValueError."""
    ego = find_rule_based(ego)
    if hasattr(ego, "in_world"):
        driver: Driver = ego.in_world(world)
        return driver
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
        driver = ego
        return driver
    refuse_ego(ego, known=tuple(RULE_BASED_EGOS))


def split_drivers(drivers: str) -> list[tuple[str, str]]:
    """Return vehicles and their policies, as in "cutter=a.zip,lead=b.zip"; none where a text has not this form."""
    parts = [each.partition("=") for each in drivers.split(",")]
    named = all(mark and name.isidentifier() for name, mark, _ in parts)
    return [(name, policy) for name, _, policy in parts] if named else []


def find_policies(drivers: Any, scenario: Scenario, trust: bool = False) -> tuple[TrafficPolicy, ...]:
    """Return the policies that an argument `drivers` puts in single vehicles around the ego; none of all other drivers.

    Args:
        drivers: A policy or its file (.zip, .onnx), for the first of these vehicles; a mapping of their names
            (`Scenario.vehicle_names`) to policies or files, also as "cutter=a.zip,lead=b.zip".
        scenario: The scenario.
        trust: Let the files of policies run code, see `agents.load_ego`.

    Raises:
        ValueError: There is no such vehicle; or the policy does not fit an agent of `rare_envs.parallel_env` with
            continuous actions.
    """
    _, *names = scenario.vehicle_names
    given: Any = (drivers := wrap_callable(drivers))
    if isinstance(drivers, str | Path):
        named = [] if isfile(drivers) else split_drivers(str(drivers))  # a path may have a "=" too
        given = dict(named) if named else drivers
        if not named and not str(drivers).endswith(POLICY_SUFFIXES):
            return ()
        if named and len(given) < len(named):
            raise ValueError(f"Expected one driver for each vehicle, got {drivers}.")
    elif not isinstance(drivers, Mapping) and not is_policy(drivers):
        return ()
    given = given if isinstance(given, Mapping) else {names[0]: given}
    for name in given:
        check_name("vehicle of the traffic", name, names)
    return tuple(
        TrafficPolicy(names.index(name) + 1, *_place_policy(name, policy, scenario, trust))
        for name, policy in given.items()
    )


POLICY_SUFFIXES = (".zip", ".onnx")
"""Endings of the files of policies that can drive traffic."""


def _place_policy(name: str, given: Any, scenario: Scenario, trust: bool) -> tuple[Driver, str]:
    """Return the driver that a policy is in a vehicle's place, and its name."""
    policy = wrap_callable(load_named_ego(given, trust))
    words = str(given) if isinstance(given, str | Path) else type(policy).__name__
    if not is_policy(policy):
        raise ValueError(f"Expected a policy with predict, or its file, to drive the {name}, got {words}.")
    needs = resolve(policy, scenario.vehicles)
    kinds = choose_observation(needs, scenario.vehicles)
    if "camera" in kinds:
        raise ValueError(f"Expected a policy without a camera to drive the {name}, got {words}.")
    space = observation_space(scenario.vehicles, kinds)
    check_spaces(policy, space, choose_action(needs.action_space, kinds), needs.observation)
    return PolicyDriver(wrap_policy(policy, space), kinds), words


def check_spaces(ego: Any, expected: spaces.Space[Any], action: str = "continuous", declared: str = "features") -> None:
    """Refuse an ego that declares other observations, `declared` for the message, or actions; bounds may differ."""
    observed, acted = (getattr(ego, f"{name}_space", None) for name in ("observation", "action"))  # anybody's object
    if observed is not None and find_frame_stacking(expected, observed) is None:
        which = "another observation" if declared == "features" else f"observation={declared!r}"
        advice = f"train it in this environment or choose {which}"
        size, given = find_picture_size(observed), find_picture_size(expected)
        if size and given and size != given:
            advice = (
                f"the camera gives {given[0]} x {given[1]} pixels, in Python camera={size} gives the ego's; on the "
                "command line name module:function, an ego that resizes them"
            )
        raise ValueError(f"The ego expects observations {observed}, the environment gives {expected}; {advice}.")
    several = isinstance(acted, spaces.MultiDiscrete | spaces.MultiBinary)
    accelerates = getattr(acted, "shape", None) == (2,) and not several
    if acted is None or takes_indices(acted) or (accelerates and action == "continuous"):
        return
    wanted, indices = "Box(-1, 1, (2,)) (acceleration, steering) or ", f"Discrete({len(DISCRETE_ACTIONS)})"
    if action != "continuous":
        wanted, indices = "", f"{indices} ({', '.join(META_ACTIONS) if action == 'meta' else 'five accelerations'})"
    advice = "put an object with predict around it that gives these, or test it in HighwayEnv's ids (docs/egos.md)."
    if accelerates:
        advice = "take action='continuous' (--action continuous) for an ego that accelerates and steers."
    raise ValueError(f"The ego acts in {acted}, the environment takes {wanted}{indices}; {advice}")
