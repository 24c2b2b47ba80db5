"""Wrappers between an environment and a policy that was trained behind them: normalised and stacked observations."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rare_envs.simulation.observation import batch_size, map_kinds

Shape = tuple[int, ...]
UNBOUNDED = "it declares observations without bounds, as behind Gymnasium's NormalizeObservation"
"""Why statistics seem to be missing: what the wrapper does to the space of observations."""


@dataclass(frozen=True)
class WrappedPolicy:
    """A policy behind what it was trained behind: normalised and stacked observations, actions with other bounds."""

    policy: Any
    normalise: Callable[[NDArray[Any]], NDArray[Any]] | None = None
    """Normalises observations, such as SB3's `VecNormalize.normalize_obs`; single ones, or stacks if `whole`."""
    frames: int = 1
    """Number k of the last observations that it sees; they are kept in its state, oldest first."""
    new_axis: bool = False
    """Whether they are along an axis of their own, as in Gymnasium's `FrameStackObservation` (copies of the first
    observation before it); else side by side along the last axis, as in SB3's `VecFrameStack` (zeros before it)."""
    whole: bool = False
    bounds: tuple[NDArray[Any], NDArray[Any]] | None = None
    """Bounds of its actions that are mapped to [-1, 1], as Gymnasium's `RescaleAction` maps them."""

    @property
    def stacks(self) -> bool:
        """Whether it sees frames."""
        return self.frames > 1 or self.new_axis

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        """Stable-Baselines3's `predict` on observations as the environment gives them, with actions in [-1, 1]."""
        seen, shown = None, observation
        if self.normalise is not None and not self.whole:
            shown = self.normalise(shown)
        if self.stacks:
            seen, state = (None, None) if state is None else state
            seen = self._add_frame(seen, shown, episode_start)
            shown = map_kinds(self._show_frames, seen)
        if self.normalise is not None and self.whole:
            shown = self.normalise(shown)
        action, state = self.policy.predict(
            shown, state=state, episode_start=episode_start, deterministic=deterministic
        )
        if self.bounds is not None:
            low, high = (bound.astype(np.float64) for bound in self.bounds)
            action = ((2.0 * np.asarray(action) - low - high) / (high - low)).astype(np.float32)
        return action, (seen, state) if self.stacks else state

    def _add_frame(self, seen: Any, shown: Any, episode_start: Any) -> Any:
        """Return the last k observations, (k, B, ...), of which the latest is shown."""
        starts = np.full(batch_size(shown), seen is None)
        if episode_start is not None:
            starts |= np.asarray(episode_start, dtype=bool)

        def add(old: NDArray[Any], now: NDArray[Any]) -> NDArray[Any]:
            new: NDArray[Any] = np.concatenate((old[1:], now[None]))
            new[:-1, starts] = now[starts] if self.new_axis else 0
            return new

        if seen is None:
            seen = map_kinds(lambda now: np.zeros((self.frames, *now.shape), now.dtype), shown)
        return map_kinds(add, seen, shown)

    def _show_frames(self, frames: NDArray[Any]) -> NDArray[Any]:
        """Return frames (k, B, ...) as the policy sees them."""
        shown = np.moveaxis(frames, 0, 1) if self.new_axis else np.concatenate(tuple(frames), axis=-1)
        return np.ascontiguousarray(shown)


def find_action_bounds(space: Any) -> tuple[NDArray[Any], NDArray[Any]] | None:
    """Return a policy's bounds of actions where they are not the environment's; else None."""
    if not isinstance(space, spaces.Box) or space.shape != (2,) or not np.isfinite([space.low, space.high]).all():
        return None
    if (space.low == -1.0).all() and (space.high == 1.0).all():
        return None
    if not (space.low < space.high).all():
        raise ValueError(f"The ego acts in {space}, whose lower bounds are not below the upper ones.")
    return space.low, space.high


def find_stacking(given: Shape, wanted: Shape) -> tuple[int, bool] | None:
    """Return how many frames of shape `given` make an observation of shape `wanted`, and whether along a new axis."""
    if wanted == given:
        return 1, False
    if len(wanted) == len(given) + 1 and wanted[1:] == given:
        return wanted[0], True
    if len(wanted) != len(given) or not given or wanted[:-1] != given[:-1]:
        return None
    frames, rest = divmod(wanted[-1], given[-1])
    return (frames, False) if frames and not rest else None


def find_frame_stacking(given: spaces.Space[Any], wanted: Any) -> tuple[int, bool] | None:
    """Return the stacking of a space in a policy's, alike in all parts of a mapping; None if they do not fit."""
    if isinstance(given, spaces.Dict):
        if not isinstance(wanted, spaces.Dict) or set(given.spaces) != set(wanted.spaces):
            return None
        stackings = {find_frame_stacking(space, wanted[name]) for name, space in given.spaces.items()}
        return stackings.pop() if len(stackings) == 1 else None
    if given.shape is None or getattr(wanted, "shape", None) is None:  # declared by anybody
        return None
    shape = tuple(wanted.shape)
    straight = find_stacking(given.shape, shape)
    if straight is None and given.dtype == wanted.dtype == np.uint8 and len(shape) == 3:  # SB3 transposes by itself
        return find_stacking(given.shape, (*shape[1:], shape[0]))
    return straight


def wrap_policy(policy: Any, given: spaces.Space[Any]) -> Any:
    """Return the policy behind the wrappers that it was trained with, so that it takes observations of a space.

    Its `action_space`, if it has one, tells the bounds of its actions, its `observation_space` how many frames it sees.
    `get_vec_normalize_env`, if it has one, gives SB3's `VecNormalize`, whose space tells whether observations are
    normalised before or after they are stacked.
    """
    # A Stable-Baselines3 model has all three; anybody else's object need not.
    bounds = find_action_bounds(getattr(policy, "action_space", None))
    wanted = getattr(policy, "observation_space", None)
    stacking = (find_frame_stacking(given, wanted) if wanted is not None else None) or (1, False)
    statistics: Any = getattr(policy, "get_vec_normalize_env", lambda: None)()
    normalise = statistics.normalize_obs if statistics is not None and statistics.norm_obs else None
    if stacking == (1, False) and normalise is None and bounds is None:
        return policy
    whole = normalise is not None and find_frame_stacking(statistics.observation_space, wanted) == (1, False)
    return WrappedPolicy(policy, normalise, *stacking, whole, bounds)


STATS_ADVICE = (
    "name their file (stats: FILE in a file for --config, load_ego(path, stats=FILE)), or hand in an ego that "
    "normalises before it predicts"
)
"""What to do about statistics that are missing or of another policy."""


def find_inner(ego: Any) -> Any:
    """Return the ego inside those that stand around another, such as `agents.imperfect_stack.NoisyEgo`."""
    while hasattr(ego, "in_world") and hasattr(ego, "ego"):
        ego = ego.ego
    return ego


def find_normalisation_doubt(ego: Any, given: spaces.Space[Any]) -> str:
    """Return what seems wrong with the statistics of an ego's observations of a space; "" if nothing does."""
    policy, doubt = find_inner(ego), ""
    if hasattr(policy, "find_normalisation_doubt"):
        doubt = str(policy.find_normalisation_doubt(given))
    elif getattr(policy, "get_vec_normalize_env", lambda: policy)() is None:
        own, bounded = policy.observation_space, isinstance(given, spaces.Box) and np.isfinite(given.high).all()
        if bounded and isinstance(own, spaces.Box) and np.isinf(own.high).all():
            doubt = f"the ego has no VecNormalize statistics, but {UNBOUNDED}; {STATS_ADVICE}"
    return doubt
