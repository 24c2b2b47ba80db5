"""The batched simulation, of one scenario or of several, as a Stable-Baselines3 `VecEnv`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from rare_envs.distributions.product import ProductDistribution
from rare_envs.distributions.stratified import StratifiedDistribution
from rare_envs.scenarios.registry import env_id_of
from rare_envs.simulation.observation import map_kinds

Indices = int | Iterable[int] | None


def sb3_vec_env(
    id: str | Sequence[str],
    num_envs: int,
    seed: int | None = None,
    even_strata: bool = False,
    reward_scale: float = 1.0,
    **make_kwargs: Any,
) -> VecMonitor:
    """Open environments of ours for Stable-Baselines3: a batched simulation of each id, many episodes.

    Args:
        id: Environment id, such as "rare_envs/CutIn-v0", or several whose observations have one space.
        num_envs: Number of episodes that run side by side; several ids share them evenly.
        seed: Seed of the first reset; an algorithm's own seed replaces it.
        even_strata: Draw the strata of a traffic model equally often, regardless of their shares, so that a policy
            meets the rare ones: of the cutters of CutIn-v1 one in 6,000 does not look.
        reward_scale: Factor of the rewards; a network of values learns soonest where they are about 1. What is
            recorded of episodes is without it.
        **make_kwargs: Keyword arguments of `gym.make` for these environments, such as `action="discrete"` for DQN.

    Returns:
        A `VecEnv` that also records returns and lengths of episodes.

    Raises:
        ValueError: `num_envs` is less than the number of ids, the environments differ in their spaces, or one refuses
            an argument.

    Example:
        >>> import numpy as np
        >>> from training import sb3_vec_env
        >>> env = sb3_vec_env("rare_envs/CutIn-v0", num_envs=4, seed=0)
        >>> env.reset().shape, env.action_space
        ((4, 11), Box(-1.0, 1.0, (2,), float32))
        >>> observation, reward, done, infos = env.step(np.zeros((4, 2), np.float32))
        >>> done.tolist()
        [False, False, False, False]
    """
    ids = (id,) if isinstance(id, str) else tuple(id)
    if not ids or num_envs < len(ids):
        raise ValueError(f"Expected num_envs >= {max(len(ids), 1)}, got {num_envs}.")
    sizes = [num_envs // len(ids) + (number < num_envs % len(ids)) for number in range(len(ids))]
    batches = [gym.make_vec(env_id_of(each), size, **make_kwargs) for each, size in zip(ids, sizes, strict=True)]
    for batch in batches if even_strata else ():
        own: Any = batch.unwrapped
        own.space = replace(own.space, base=_even_out(own.space.base))
    env = BatchedVecEnv(*batches)
    if seed is not None:
        env.seed(seed)
    return ScaledRewards(env, reward_scale)


def _even_out(base: Any) -> Any:
    """Return a traffic model, or one that an environment draws the same from, with strata of equal shares."""
    plain = getattr(base, "distribution", base)
    if isinstance(plain, ProductDistribution):
        return ProductDistribution(tuple(map(_even_out, plain.blocks)))
    if not isinstance(plain, StratifiedDistribution):
        return base
    return replace(plain, strata=tuple(each._replace(share=1 / len(plain.strata)) for each in plain.strata))


def sb3_agents_env(
    id: str,
    num_scenarios: int,
    agents: Sequence[str] | None = None,
    ego: Any = "idm",
    rewards: Mapping[str, Any] | None = None,
    seed: int | None = None,
    **make_kwargs: Any,
) -> VecMonitor:
    """Open an environment of ours for one Stable-Baselines3 policy that several agents share.

    Args:
        id: Environment id, such as "rare_envs/CutIn-v0".
        num_scenarios: B, scenarios side by side in one simulation; each agent of each is a row.
        agents: Names of the vehicles that act, of A; None for all. With one of them in the background this is the
            training of an adversary.
        ego: Driver of the ego if it is no agent: "idm", a driver or a policy.
        rewards: Reward functions by agent (`rare_envs.multi_agent`); by default that of an ego, in its own
            view.
        seed: Seed of the first reset; an algorithm's own seed replaces it.
        **make_kwargs: Keyword arguments of `gym.make` for this environment.

    Returns:
        A `VecEnv` of B A rows that also records returns and lengths of episodes.

    Raises:
        ValueError: An argument is refused.

    Example:
        >>> from training import sb3_agents_env
        >>> env = sb3_agents_env("rare_envs/CutIn-v0", num_scenarios=2, agents=["cutter"], seed=0)
        >>> env.num_envs, len(env.reset())
        (2, 2)
    """
    from rare_envs.envs.parallel import AgentsVectorEnv

    env = BatchedVecEnv(AgentsVectorEnv(id, num_scenarios, agents=agents, ego=ego, rewards=rewards, **make_kwargs))
    if seed is not None:
        env.seed(seed)
    return VecMonitor(env)


class ScaledRewards(VecMonitor):
    """Records returns and lengths of episodes, and passes the rewards on with a factor."""

    def __init__(self, env: VecEnv, factor: float) -> None:
        """Wrap an environment."""
        super().__init__(env)
        self.factor = np.float32(factor)

    def step_wait(self) -> tuple[Any, NDArray[Any], NDArray[Any], list[dict[str, Any]]]:
        """Advance by one step."""
        observation, reward, done, infos = super().step_wait()
        return observation, reward * self.factor, done, infos


class BatchedVecEnv(VecEnv):
    """Adapter from Gymnasium `VectorEnv`s with same-step autoreset, one or several side by side, to a `VecEnv`.

    The infos of a step are empty except for episodes that ended in it: those hold what the environment said of the
    end, `terminal_observation` and `TimeLimit.truncated`. Seed and options apply to the next reset. All environments
    of a batch live in one simulation, so attributes and methods are those of the batch.
    """

    def __init__(self, *batches: VectorEnv[Any, Any, Any]) -> None:
        """Wrap batches with equal spaces."""
        first = batches[0]
        for batch in batches:
            mode = batch.metadata.get("autoreset_mode")
            if mode != AutoresetMode.SAME_STEP:
                raise ValueError(f"Expected a VectorEnv with same-step autoreset, got {mode}.")
            for name in ("single_observation_space", "single_action_space"):
                one, other = getattr(first, name), getattr(batch, name)
                if one != other:
                    raise ValueError(f"Expected environments with one {name}, got {one} and {other}.")
        self.batches = batches
        ends = np.cumsum([batch.num_envs for batch in batches]).tolist()
        self._rows = [slice(end - batch.num_envs, end) for batch, end in zip(batches, ends, strict=True)]
        self._actions: NDArray[Any] | None = None
        super().__init__(ends[-1], first.single_observation_space, first.single_action_space)

    def reset(self) -> Any:
        """Start new episodes everywhere, with the seed and options set before, if any."""
        observations = []
        self.reset_infos = []
        for batch, rows in zip(self.batches, self._rows, strict=True):
            options = merge_options(self._options[rows])
            observation, infos = batch.reset(seed=self._seeds[rows.start], options=options)
            self.reset_infos += info_rows(infos, range(batch.num_envs))
            observations.append(observation)
        self._reset_seeds()
        self._reset_options()
        return _join(observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions for `step_wait`, shape (B, 2), or (B,) for discrete ones."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, NDArray[Any], NDArray[Any], list[dict[str, Any]]]:
        """Advance the batches by one step; ended episodes are followed by new ones at once."""
        assert self._actions is not None
        parts = [self._step(*each) for each in zip(self.batches, self._rows, strict=True)]
        observation, reward, done, infos = zip(*parts, strict=True)
        return _join(observation), np.concatenate(reward), np.concatenate(done), [row for part in infos for row in part]

    def _step(self, batch: VectorEnv[Any, Any, Any], rows: slice) -> tuple[Any, ...]:
        """Advance one batch; return its observations, rewards, ends and infos."""
        assert self._actions is not None
        observation, reward, terminated, truncated, infos = batch.step(self._actions[rows])
        done = np.logical_or(terminated, truncated)
        ends: list[dict[str, Any]] = [{} for _ in range(batch.num_envs)]
        over = np.flatnonzero(done).tolist()
        finals, begun = info_rows(infos.get("final_info", {}), over), info_rows(infos, over)
        for row, final, info in zip(over, finals, begun, strict=True):
            final["terminal_observation"] = map_kinds(np.asarray, infos["final_obs"][row])
            final["TimeLimit.truncated"] = bool(truncated[row] and not terminated[row])
            ends[row], self.reset_infos[rows.start + row] = final, info
        return observation, np.asarray(reward, dtype=np.float32), done, ends

    def close(self) -> None:
        """Close the batches."""
        for batch in self.batches:
            batch.close()

    def get_images(self) -> Sequence[NDArray[Any] | None]:
        """Return images of the environments, as many as the batches render."""
        frames: list[Any] = [batch.render() for batch in self.batches]
        return [image for part in frames for image in part or ()]

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return the attribute of its batch, for each of the environments."""
        values = [value for batch in self.batches for value in [_find(batch, attr_name)] * batch.num_envs]
        return [values[row] for row in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of batches; for all environments of one or for none."""
        for batch in self._chosen(indices, attr_name):
            setattr(batch.unwrapped, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of a batch once, for all of its environments; its result stands for each."""
        found: list[Any] = []
        for batch in self._chosen(indices, method_name):
            found += [_find(batch, method_name)(*method_args, **method_kwargs)] * batch.num_envs
        return found

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: Indices = None
    ) -> list[bool]:
        """Return False for each: single-environment wrappers cannot be inside a batch."""
        del wrapper_class
        return [False for _ in self._get_indices(indices)]

    def _chosen(self, indices: Indices, name: str) -> list[VectorEnv[Any, Any, Any]]:
        """Return the batches with these rows; refuse a part of one, whose environments share one simulation."""
        asked, found = set(self._get_indices(indices)), list[VectorEnv[Any, Any, Any]]()
        for batch, rows in zip(self.batches, self._rows, strict=True):
            own = set(range(rows.start, rows.stop))
            if asked & own and not own <= asked:
                raise ValueError(
                    f"Expected {name!r} for all {batch.num_envs} environments, got {sorted(asked & own)}: "
                    "they share one batched simulation; leave indices out."
                )
            found += [batch] if own <= asked else []
        return found


def _join(observations: Sequence[Any]) -> Any:
    """Return the observations of batches below each other; those of one as they are."""
    if len(observations) == 1:
        return map_kinds(np.asarray, observations[0])
    return map_kinds(lambda *parts: np.concatenate(parts), *observations)


def _find(batch: VectorEnv[Any, Any, Any], name: str) -> Any:
    """Return an attribute of a batch or of the environment inside its wrappers; Stable-Baselines3 names it."""
    return getattr(batch if hasattr(batch, name) else batch.unwrapped, name)


def merge_options(options: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """Join reset options of B environments, of the same names, into those of a batch (B, ...); None without any."""
    if not any(options):
        return None
    names = set(options[0])
    if any(set(single) != names for single in options):
        raise ValueError(
            "Expected the same option names for every environment of a batch, got "
            f"{sorted({name for single in options for name in single})} on some of them only."
        )
    return {name: np.stack([np.asarray(single[name]) for single in options]) for name in names}


def info_rows(infos: Mapping[str, Any], rows: Sequence[int]) -> list[dict[str, Any]]:
    """Return the infos of some environments, taken out of those of a batch, where `_name` masks `name`.

    `final_obs` and `final_info` belong to the episodes before, not to these.
    """
    found: list[dict[str, Any]] = [{} for _ in rows]
    for name, value in infos.items() if rows else ():
        if name.startswith("_") or name in ("final_obs", "final_info"):
            continue
        parts = info_rows(value, rows) if isinstance(value, Mapping) else [value[row] for row in rows]
        mask = infos.get(f"_{name}")
        for row, single, part in zip(rows, found, parts, strict=True):
            if mask is None or mask[row]:
                single[name] = part
    return found
