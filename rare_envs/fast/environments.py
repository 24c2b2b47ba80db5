"""Compiled steps of environments: an episode and actions to the episode a tick later, its reward and its features."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from rare_envs.control.actions import DISCRETE_ACTIONS, MAX_ACCELERATION, MAX_STEERING
from rare_envs.fast.choice import CompilerFails, check_core, find_step_script, import_compiler
from rare_envs.fast.dense_policy import NotCompiled
from rare_envs.measures.base import COLLISION
from rare_envs.scenarios.cut_in import CUTTER_IDM
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.measurement import EpisodeStatistics
from rare_envs.simulation.reward import RewardTerms
from rare_envs.traffic.crash import Crash
from rare_envs.traffic.neighbours import Lead
from rare_envs.traffic.state import State

if TYPE_CHECKING:
    from rare_envs.simulation.world import World

ACTION_SCALES = np.array([MAX_ACCELERATION, MAX_STEERING], dtype=np.float32)
"""Acceleration [m/s^2] and steering angle [rad] of an action of 1."""


class CompiledStep(NamedTuple):
    """Result of a decision in B episodes; see `rare_envs.simulation.decision.StepResult`."""

    episode: Episode
    terms: RewardTerms
    features: NDArray[np.float32]
    """The observation `features`, shape (B, F)."""


class ScriptedStep:
    """Compiled steps of a world."""

    def __init__(self, world: World, required: bool = False) -> None:
        """Take the numbers of a world.

        Args:
            world: The world.
            required: Whether states in double precision are refused, not left to torch.

        Raises:
            NotCompiled: Its steps are not compiled.
            CompilerFails: numba does not work here.
        """
        script = find_step_script(world)
        import_compiler()
        from rare_envs.fast import scripts
        from rare_envs.fast.compilation import single
        from rare_envs.fast.equations import IDMNumbers, RoadNumbers

        (dt,) = single(world.clock.dt)
        road = RoadNumbers.of(world.scenario.road)
        self._numbers = getattr(scripts, script), IDMNumbers.of(CUTTER_IDM), road, dt
        self._required = required

    def advance(self, episode: Episode, action: NDArray[Any]) -> CompiledStep | None:
        """Carry out a decision.

        Args:
            episode: B episodes.
            action: Of the ego, in [-1, 1], shape (B, 2), or numbers of discrete actions, shape (B,).

        Returns:
            The episodes a tick later, and the reward; None for an action that has to be refused, for episodes in
            which vehicles were commanded, and for states in double precision.

        Raises:
            ValueError: The state is in double precision, and compiled steps are required.
        """
        from rare_envs.fast.crashes import CrashRows, record_crashes  # not kept: a step is copied and sent
        from rare_envs.fast.rows import make_table, stack_state
        from rare_envs.fast.steps import Stepped, step

        old, f, vehicles = episode.state, episode.measure_state.numpy(), episode.state.x.shape[1]
        physical = scale_actions(action, len(f))
        if physical is None or episode.overridden is not None or episode.statistics is None:
            return None
        if old.x.dtype != torch.float32 or f.dtype != np.float32:
            if self._required:
                raise ValueError(
                    "core='numba' steps states in single precision, got one in "
                    f"{old.x.numpy().dtype}; make the environment with core='torch'."
                )
            return None
        start, stepped = stack_state(old), Stepped.of(f, vehicles)
        table = make_table(start, vehicles, len(f))
        script, cutter_idm, road, dt = self._numbers
        eventful = step(table, vehicles, physical, script, cutter_idm, road, dt, stepped)
        tensor = torch.from_numpy
        before, after = (each[: 4 * vehicles].reshape(4, vehicles, len(f)) for each in (start, table))
        x, y, heading, speed = (tensor(field.T) for field in after)
        state = State(x, y, heading, speed, old.theta)
        lead, now, least = Lead(*map(tensor, stepped.lead)), tensor(stepped.f == COLLISION), tensor(stepped.f)
        statistics = episode.statistics._replace(least_ttc=least)
        if eventful:
            own, others = (CrashRows(*(field.numpy().copy() for field in each)) for each in statistics[1:])
            record_crashes(before, after, episode.collided.numpy(), now.numpy(), road, dt, own, others)
            statistics = EpisodeStatistics(least, *(Crash(*map(tensor, each)) for each in (own, others)))
        moved = episode._replace(state=state, lead=lead, measure_state=least, collided=now, statistics=statistics)
        return CompiledStep(moved, RewardTerms(*map(tensor, stepped.terms)), np.ascontiguousarray(stepped.features.T))


def find_scripted_step(world: World, core: str = "auto") -> ScriptedStep | None:
    """Return the compiled steps of a world; None where torch has to carry them out.

    Args:
        world: With statistics or without.
        core: "torch" for none, "auto" for compiled ones where they can be had, "numba" for an error elsewhere.

    Raises:
        ValueError: There is no such core, or "numba" cannot carry out these steps.
    """
    check_core(core)
    if core == "torch":
        return None
    try:
        return ScriptedStep(world, required=core == "numba")
    except NotCompiled as reason:
        if core == "numba":
            raise ValueError(f"core='numba' cannot simulate this: {reason}.") from reason
        if isinstance(reason, CompilerFails):
            warnings.warn(f"{reason}; torch simulates, which is slower.", stacklevel=3)
    return None


def scale_actions(action: NDArray[Any], batch: int) -> NDArray[np.float32] | None:
    """Return accelerations [m/s^2] and steering angles [rad], shape (B, 2); None for what `to_physical` refuses.

    Args:
        action: In [-1, 1], shape (B, 2), or numbers of `DISCRETE_ACTIONS`, shape (B,).
        batch: B.

    Example:
        >>> scale_actions(np.array([[1.0, -2.0]]), 1).tolist(), scale_actions(np.array([[0.0, np.nan]]), 1)
        ([[5.0, -0.10000000149011612]], None)
    """
    if action.shape == (batch,) and action.dtype.kind in "iu":
        if action.min() < 0 or action.max() >= len(DISCRETE_ACTIONS):
            return None
        action = DISCRETE_ACTIONS[action]
    if action.shape != (batch, 2) or action.dtype.kind not in "fiu":
        return None
    action = action.astype(np.float32)
    if not np.isfinite(action).all():
        return None
    return np.asarray(action.clip(-1.0, 1.0) * ACTION_SCALES, dtype=np.float32)
