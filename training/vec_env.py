"""The batched simulation as a Stable-Baselines3 `VecEnv`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from rare_envs.simulation.observation import map_kinds

Indices = int | Iterable[int] | None


def sb3_vec_env(
    id: str,
    num_envs: int,
    seed: int | None = None,
    discrete: bool = False,
    **make_kwargs: Any,
) -> VecMonitor:
    """Open an environment of ours for Stable-Baselines3: one batched simulation, many episodes.

    Args:
        id: Environment id, such as "rare_envs/CutIn-v0".
        num_envs: Number of episodes that run side by side.
        seed: Seed of the first reset; an algorithm's own seed replaces it.
        discrete: Offer the rows of `rare_envs.control.actions.DISCRETE_ACTIONS` as a `Discrete` action
            space, for algorithms such as DQN; an environment with `action="meta"` has one already.
        **make_kwargs: Keyword arguments of `gym.make` for this environment.

    Returns:
        A `VecEnv` that also records returns and lengths of episodes.

    Raises:
        ValueError: `num_envs` is not positive, or the environment refuses an argument.

    Example:
        >>> env = sb3_vec_env("rare_envs/CutIn-v0", num_envs=4, seed=0)
        >>> env.reset().shape, env.action_space
        ((4, 11), Box(-1.0, 1.0, (2,), float32))
        >>> observation, reward, done, infos = env.step(np.zeros((4, 2), np.float32))
        >>> done.tolist()
        [False, False, False, False]
    """
    import rare_envs
    from rare_envs.control.actions import DISCRETE_ACTIONS

    if num_envs < 1:
        raise ValueError(f"Expected num_envs >= 1, got {num_envs}.")
    batch = rare_envs.make_batch(id, num_envs, **make_kwargs)
    continuous = isinstance(batch.single_action_space, gym.spaces.Box)
    env = BatchedVecEnv(batch, np.asarray(DISCRETE_ACTIONS) if discrete and continuous else None)
    if seed is not None:
        env.seed(seed)
    return VecMonitor(env)


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
        >>> env = sb3_agents_env("rare_envs/CutIn-v0", num_scenarios=2, agents=["cutter"], seed=0)
        >>> env.num_envs, len(env.reset())
        (2, 2)
    """
    from rare_envs.envs.parallel import AgentsVectorEnv

    env = BatchedVecEnv(AgentsVectorEnv(id, num_scenarios, agents=agents, ego=ego, rewards=rewards, **make_kwargs))
    if seed is not None:
        env.seed(seed)
    return VecMonitor(env)


class BatchedVecEnv(VecEnv):
    """Adapter from a Gymnasium `VectorEnv` with same-step autoreset to a `VecEnv`.

    The infos of a step are empty except for episodes that ended in it: those hold what the environment said of the
    end, `terminal_observation` and `TimeLimit.truncated`. Seed and options apply to the next reset. All environments
    live in one simulation, so attributes and methods are those of the batch.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], discrete_actions: NDArray[Any] | None = None) -> None:
        """Wrap a batch with same-step autoreset; continuous actions (K, 2) may be chosen from by index."""
        mode = env.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise ValueError(f"Expected a VectorEnv with same-step autoreset, got {mode}.")
        self.env = env
        self._table = discrete_actions
        self._actions: NDArray[Any] | None = None
        action_space = env.single_action_space
        if discrete_actions is not None:
            action_space = gym.spaces.Discrete(len(discrete_actions))
        super().__init__(env.num_envs, env.single_observation_space, action_space)

    def reset(self) -> Any:
        """Start new episodes everywhere, with the seed and options set before, if any."""
        options = merge_options(self._options)
        observation, infos = self.env.reset(seed=self._seeds[0], options=options)
        self.reset_infos = [info_row(infos, row) for row in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return map_kinds(np.asarray, observation)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions for `step_wait`, shape (B, 2), or (B,) for discrete ones."""
        self._actions = actions if self._table is None else self._table[actions]

    def step_wait(self) -> tuple[Any, NDArray[Any], NDArray[Any], list[dict[str, Any]]]:
        """Advance the batch by one step; ended episodes are followed by new ones at once."""
        observation, reward, terminated, truncated, infos = self.env.step(self._actions)
        done = np.logical_or(terminated, truncated)
        rows: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(done).tolist():
            rows[row] = info_row(infos.get("final_info", {}), row)
            rows[row]["terminal_observation"] = map_kinds(np.asarray, infos["final_obs"][row])
            rows[row]["TimeLimit.truncated"] = bool(truncated[row] and not terminated[row])
            self.reset_infos[row] = info_row(infos, row)
        return map_kinds(np.asarray, observation), np.asarray(reward, dtype=np.float32), done, rows

    def close(self) -> None:
        """Close the batch."""
        self.env.close()

    def get_images(self) -> Sequence[NDArray[Any] | None]:
        """Return images of the environments, as many as the batch renders."""
        frames: Any = self.env.render()
        return list(frames or ())

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return the batch's attribute, once for each of the environments."""
        value = self._find(attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of the batch; for all environments or not at all."""
        self._refuse_part(indices, attr_name)
        setattr(self.env.unwrapped, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the batch once, for all environments; its result stands for each."""
        self._refuse_part(indices, method_name)
        result = self._find(method_name)(*method_args, **method_kwargs)
        return [result for _ in range(self.num_envs)]

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: Indices = None
    ) -> list[bool]:
        """Return False for each: single-environment wrappers cannot be inside a batch."""
        del wrapper_class
        return [False for _ in self._get_indices(indices)]

    def _find(self, name: str) -> Any:
        """Return an attribute of the batch or of the environment inside its wrappers."""
        # the name comes from Stable-Baselines3
        return getattr(self.env if hasattr(self.env, name) else self.env.unwrapped, name)

    def _refuse_part(self, indices: Indices, name: str) -> None:
        """Refuse indices that leave some out: the environments share one simulation and cannot differ."""
        asked = set(self._get_indices(indices))
        if asked != set(range(self.num_envs)):
            raise ValueError(
                f"Expected {name!r} for all {self.num_envs} environments, got {sorted(asked)}: "
                "they share one batched simulation; leave indices out."
            )


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


def info_row(infos: Mapping[str, Any], row: int) -> dict[str, Any]:
    """Return the info of one environment, taken out of the infos of a batch, where `_name` masks `name`.

    `final_obs` and `final_info` belong to the episode before, not to this one.
    """
    single: dict[str, Any] = {}
    for name, value in infos.items():
        mask = infos.get(f"_{name}")
        absent = mask is not None and not mask[row]
        if name.startswith("_") or name in ("final_obs", "final_info") or absent:
            continue
        single[name] = info_row(value, row) if isinstance(value, Mapping) else value[row]
    return single
