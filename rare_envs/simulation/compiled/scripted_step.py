"""Steps of environments of scripted scenarios, compiled: a decision of one tick for a whole batch in one call."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from rare_envs.control.actions import DISCRETE_ACTIONS, MAX_ACCELERATION, MAX_STEERING
from rare_envs.scenarios.cut_in import CUTTER_IDM
from rare_envs.simulation.compiled.failures import CompilerFails, NotCompiled, check_core, compiler_failures
from rare_envs.simulation.compiled.selection import find_compiled_script
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.episode_statistics import EpisodeStatistics
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
    """Compiled steps of a world.

    Example:
        >>> from rare_envs.scenarios.car_following import CAR_FOLLOWING
        >>> from rare_envs.simulation import World
        >>> world = World(CAR_FOLLOWING).with_statistics()
        >>> step = find_scripted_step(world)
        >>> moved = step.advance(world.start(torch.tensor([[20.0, 15.0, 30.0]])), np.zeros((1, 2), np.float32))
        >>> round(float(moved.episode.lead.gap), 2), round(float(moved.terms.total), 2)
        (29.5, 0.92)
    """

    def __init__(self, world: World, required: bool = False) -> None:
        """Take the numbers of a world.

        Args:
            world: The world.
            required: Whether states in double precision are refused, not left to torch.

        Raises:
            NotCompiled: Its steps are not compiled, or numba is missing.
            CompilerFails: numba cannot be used here.
        """
        script = find_compiled_script(world)
        if world.clock.action == "meta":
            raise NotCompiled("meta-actions are not compiled")
        with compiler_failures():
            from rare_envs.compilation import single
            from rare_envs.simulation.compiled import tick_kernel
            from rare_envs.simulation.compiled.equations import IDMNumbers, RoadNumbers

            scripts = {
                "car_following": tick_kernel.CAR_FOLLOWING_SCRIPT,
                "cut_in": tick_kernel.CUT_IN_SCRIPT,
                "hard_brake": tick_kernel.HARD_BRAKE_SCRIPT,
            }
            (dt,) = single(world.clock.dt)
            self._numbers = (IDMNumbers.of(CUTTER_IDM), RoadNumbers.of(world.scenario.road), dt)
            self._number, self._required = scripts[script], required
            self._try(world)

    def _try(self, world: World) -> None:
        """Compile, or load what was compiled, by a tick of one episode."""
        low = [parameter.low for parameter in world.scenario.column_parameters]
        with torch.inference_mode():
            episode = world.with_statistics().start(torch.tensor([low]))
        moved = self.advance(episode, np.zeros((1, 2), dtype=np.float32))
        assert moved is not None and moved.episode.statistics is not None
        traffic, over = stack_traffic(episode.state), episode.collided.numpy()
        self._record_crashes(moved.episode.statistics, traffic, traffic, over, over)

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
        from rare_envs.simulation.compiled import tick_kernel  # not kept: a step is copied and sent

        old, statistics = episode.state, episode.statistics
        physical = scale_actions(action, len(old.x))
        if physical is None or episode.overridden is not None or statistics is None:
            return None
        traffic = stack_traffic(old)
        theta, f, collided = old.theta.numpy(), episode.measure_state.numpy(), episode.collided.numpy()
        if traffic.dtype != np.float32 or f.dtype != np.float32:
            if self._required:
                raise ValueError(
                    "core='numba' steps states in single precision, got one in "
                    f"{max(traffic.dtype, f.dtype)}; make the environment with core='torch'."
                )
            return None
        contiguous = np.ascontiguousarray
        theta = contiguous(theta) if theta.shape[1] else traffic[0]
        cutter, road, dt = self._numbers
        before = contiguous(collided)
        ticked = tick_kernel.Ticked.of(traffic, contiguous(f), before)
        eventful = tick_kernel.tick_scripted(self._number, theta, physical, cutter, road, dt, ticked)
        tensor = torch.from_numpy
        x, y, heading, speed = map(tensor, ticked.traffic)
        state, lead = State(x, y, heading, speed, old.theta), Lead(*map(tensor, ticked.lead))
        least, now = tensor(ticked.f), tensor(ticked.collided)
        statistics = statistics._replace(least_ttc=least)
        if eventful:
            statistics = self._record_crashes(statistics, traffic, ticked.traffic, before, ticked.collided)
        episode = episode._replace(state=state, lead=lead, measure_state=least, collided=now, statistics=statistics)
        return CompiledStep(episode, RewardTerms(*map(tensor, ticked.terms)), ticked.features)

    def _record_crashes(
        self,
        statistics: EpisodeStatistics,
        before: NDArray[np.float32],
        after: NDArray[np.float32],
        was_over: NDArray[np.bool_],
        is_over: NDArray[np.bool_],
    ) -> EpisodeStatistics:
        """Return statistics with the crashes of a tick; traffic as of `stack_traffic`, and who had collided by then."""
        from rare_envs.simulation.compiled.crash_kernel import CrashRows, record_crashes

        own, others = (CrashRows(*(field.numpy().copy() for field in each)) for each in statistics[1:])
        _, road, dt = self._numbers
        record_crashes(before, after, was_over, is_over, road, dt, own, others)
        crashes = (Crash(*map(torch.from_numpy, each)) for each in (own, others))
        return EpisodeStatistics(statistics.least_ttc, *crashes)


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


def stack_traffic(state: State) -> NDArray[Any]:
    """Return x, y, heading and speed, shape (4, B, N)."""
    return np.stack([field.numpy() for field in state[:4]])


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
