"""Reinforcement learning of an ego in the batched simulation, saved as a `.zip`."""

from __future__ import annotations

import hashlib
import io
import math
import os
import time
import warnings
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rare_envs.distributions.coordinates import FloatArray
from rare_envs.distributions.space import Distribution, ScenarioSpace
from rare_envs.files import replace_file
from rare_envs.plugins import did_you_mean
from rare_envs.startup import use_one_thread
from samplers.estimation import NARROW_TERMINAL, defer_signals
from training.checkpoints import TrainingInterrupted, load_checkpoint, restore_model, save_checkpoint

if TYPE_CHECKING:
    from rich.progress import Progress

CHECKPOINT_SUFFIX, CHECKPOINT_SECONDS = ".checkpoint", 30.0
"""Ending of the file beside the ego, and the time between checkpoints [s]."""
RECENT = 500
"""Number of last episodes in the collision rate beside the progress bar."""


@dataclass(frozen=True)
class Hyperparameters:
    """Settings of one algorithm for a batched simulation and few CPU cores."""

    settings: Mapping[str, Any]
    """Arguments of the Stable-Baselines3 algorithm."""
    policy: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of its policy, `policy_kwargs`; ReLU is added, the fastest activation on a CPU."""
    discrete: bool = False
    """Whether it acts by rows of `rare_envs.control.actions.DISCRETE_ACTIONS`."""
    noise: float = 0.0
    """Standard deviation of the exploration noise of a policy that has none of its own."""
    reward_scale: float = 1.0
    """Factor of the rewards that it learns from."""
    num_envs: int = 256
    """Episodes that run side by side."""


# A simulation step of hundreds of environments costs about as much as one of a few, so rollouts are
# short and wide, batches large and networks small. Returns look about 5 s ahead (gamma = 0.98 at
# 0.1 s). Exploration starts small: random steering leaves the road before braking is learnt.
# benchmarks/training/speed.py has what epochs, gradient steps and returns of several steps cost and buy.
# The actor runs in every estimate, the critic not.
_ACTOR_CRITIC = {"net_arch": {"pi": [32, 32], "vf": [64, 64]}, "log_std_init": -1.5}
_ON_POLICY = {"gamma": 0.98, "gae_lambda": 0.98}
_PPO = {**_ON_POLICY, "n_steps": 32, "batch_size": 2048, "n_epochs": 3, "clip_range": 0.4, "learning_rate": 3e-3}
_PPO_POLICY = {**_ACTOR_CRITIC, "log_std_init": -1.0, "optimizer_kwargs": {"eps": 1e-5, "fused": True}}
_A2C = {**_ON_POLICY, "gae_lambda": 0.95, "n_steps": 5, "learning_rate": 3e-3, "normalize_advantage": True}
# Off-policy: one step of the whole batch, then so many updates. What happens reaches the values of the steps
# before it in fewer updates where returns are of several steps.
_OFF_POLICY = {"gamma": 0.98, "train_freq": 1, "learning_rate": 1e-3}
_SAC = {**_OFF_POLICY, "n_steps": 3, "batch_size": 256, "gradient_steps": 6, "tau": 0.0133}
_TD3 = {**_OFF_POLICY, "batch_size": 1024, "gradient_steps": 8}
_DQN = {**_OFF_POLICY, "n_steps": 2, "batch_size": 768, "gradient_steps": 4, "target_update_interval": 4096}
_DQN |= {"exploration_fraction": 0.3, "exploration_final_eps": 0.02}
_NETS = {"net_arch": [64, 64], "optimizer_kwargs": {"fused": True}}
HYPERPARAMETERS: Mapping[str, Hyperparameters] = MappingProxyType(
    {
        "ppo": Hyperparameters(_PPO, _PPO_POLICY, reward_scale=0.02, num_envs=320),
        "a2c": Hyperparameters(_A2C, _ACTOR_CRITIC),
        "sac": Hyperparameters(_SAC, _NETS),
        "td3": Hyperparameters(_TD3, _NETS, noise=0.2),
        "dqn": Hyperparameters(_DQN, _NETS, discrete=True),
    }
)


@dataclass(frozen=True, eq=False)
class Retraining:
    """What `train_ego` goes on from: an ego that it trained before, and scenarios in which that ego failed.

    Raises:
        ValueError: There is no failure, they are no table of finite numbers, or the share is not between 0 and 1.

    Example:
        >>> import numpy as np
        >>> from pathlib import Path
        >>> from training import Retraining
        >>> Retraining(Path("ego.zip"), np.zeros((3, 6)), share=0.25)
        Retraining(ego=PosixPath('ego.zip'), share=0.25)
        >>> Retraining(Path("ego.zip"), np.zeros((0, 6)))
        Traceback (most recent call last):
        ...
        ValueError: Expected failures of shape (k, d) with k >= 1 and finite values, got shape (0, 6).
    """

    ego: Path
    """The `.zip` of the ego."""
    failures: FloatArray = field(repr=False)
    """Scenarios in the order of x of the environment, shape (k, d)."""
    share: float = 0.25
    """Share of episodes that begin in one of the failures, drawn uniformly; the others begin in ordinary scenarios."""

    def __post_init__(self) -> None:
        x = np.asarray(self.failures, dtype=np.float64)
        if x.ndim != 2 or not len(x) or not np.isfinite(x).all():
            raise ValueError(
                f"Expected failures of shape (k, d) with k >= 1 and finite values, got shape {np.shape(self.failures)}."
            )
        if not (math.isfinite(self.share) and 0.0 < self.share < 1.0):
            raise ValueError(f"Expected a share of failures above 0 and below 1, got {self.share!r}.")
        object.__setattr__(self, "failures", x)

    def arguments(self) -> dict[str, str]:
        """Return what a checkpoint notes of it: a resumed training has to go on from the same ego and failures."""
        if not self.ego.is_file():
            raise FileNotFoundError(f"No ego at {str(self.ego)!r}.")
        ego, failures = (
            hashlib.sha256(content).hexdigest() for content in (self.ego.read_bytes(), self.failures.tobytes())
        )
        return {"retrained": ego, "failures": failures, "failure_share": str(self.share)}

    def mix(self, space: ScenarioSpace) -> ScenarioSpace:
        """Return the space of an environment with the failures, which have to be of it, among its draws."""
        failures = space.validate(self.failures)

        def sample(n: int, rng: np.random.Generator) -> FloatArray:
            x = np.array(space.base.sample(n, rng))
            chosen = rng.random(n) < self.share
            x[chosen] = failures[rng.integers(0, len(failures), int(chosen.sum()))]
            return x

        return replace(space, base=cast(Distribution, SimpleNamespace(sample=sample)))  # an environment only draws


def train_ego(
    env_id: str | Sequence[str],
    algo: str = "ppo",
    steps: int = 200_000,
    seed: int = 0,
    num_envs: int | None = None,
    out: str | Path = Path("ego.zip"),
    progress: bool = True,
    resume: bool = False,
    force: bool = False,
    checkpoint_interval: float = CHECKPOINT_SECONDS,
    retraining: Retraining | None = None,
    even_strata: bool = True,
    **make_kwargs: Any,
) -> Path:
    """Train an ego and save it.

    Equal arguments give equal weights on the same machine, whether the training was interrupted and resumed or not.

    Args:
        env_id: Environment id, such as "rare_envs/CutIn-v0", or several whose observations have one space.
        algo: One of `HYPERPARAMETERS`: "ppo", "a2c", "sac", "td3", "dqn".
        steps: Environment steps, summed over the batch; rounded up to whole rollouts.
        seed: Seed of the networks, the exploration and the scenarios.
        num_envs: Episodes that run side by side; by default 320 with PPO and 256 with the others.
        out: The `.zip` to write; missing folders are made, a missing suffix is added.
        progress: Show a bar with the mean return and the collision rate on standard error.
        resume: Go on with a training that was interrupted, from the checkpoint beside `out`.
        force: Replace an ego that is in `out`, or an unfinished training beside it.
        checkpoint_interval: Time between checkpoints [s]; the last one is removed when the ego is saved.
        retraining: An ego to go on from, in place of a new one, and failures of the one environment, which are mixed
            into the scenarios.
        even_strata: Draw the strata of traffic models equally often, regardless of their shares: an ego that meets a
            cutter who does not look once in 6,000 episodes does not learn to expect one.
        **make_kwargs: Keyword arguments of `gym.make_vec` for this environment; `device` places networks that
            see pictures too.

    Returns:
        Path of the `.zip`, which `agents.load_ego` and Stable-Baselines3 read.

    Raises:
        ValueError: An argument is not usable, there is an ego in `out` or an unfinished training beside it and neither
            is to be replaced, or there is none to resume; nothing has been simulated then.
        OSError: The ego cannot be written; what was in the file before stays, and the checkpoint has the training.
        TrainingInterrupted: After a signal, which waits for the end of a rollout; the checkpoint has the training.

    Example:
        >>> import tempfile
        >>> from agents import load_ego
        >>> from training import train_ego
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = train_ego("rare_envs/CutIn-v0", "a2c", 20, num_envs=4, out=f"{folder}/ego", progress=False)
        ...     print(path.name, load_ego(path).algorithm)
        ego.zip a2c
    """
    if algo not in HYPERPARAMETERS:
        hint = did_you_mean(algo.lower(), HYPERPARAMETERS)
        raise ValueError(f"Unknown algorithm {algo!r}{hint}; expected one of {', '.join(HYPERPARAMETERS)}.")
    if steps < 1:
        raise ValueError(f"Expected steps >= 1, got {steps}.")
    if not 0 <= seed < 2**32:
        raise ValueError(f"Expected a seed from 0 to 2^32 - 1, got {seed}.")
    from rare_envs.scenarios.registry import env_id_of, split_layout

    ids = tuple(map(env_id_of, (env_id,) if isinstance(env_id, str) else env_id))
    if not ids or len(set(ids)) < len(ids) or (retraining is not None and len(ids) > 1):
        which = "one environment to train on in" if retraining else "different environments, one or more"
        raise ValueError(f"Expected {which}, got {', '.join(ids) or 'none'}.")
    hyperparameters = HYPERPARAMETERS[algo]
    num_envs = hyperparameters.num_envs if num_envs is None else num_envs
    target, device = _prepare_target(Path(out)), make_kwargs.get("device", "cpu")
    arguments = {"env_id": ",".join(ids), "algo": algo, "steps": steps, "seed": seed, "num_envs": num_envs}
    settings_digest = hashlib.sha256(repr(hyperparameters).encode()).hexdigest()[:8]
    arguments |= {"even_strata": even_strata, "settings": settings_digest}
    arguments |= {name: str(value) for name, value in make_kwargs.items() if value is not None}
    arguments |= {} if retraining is None else retraining.arguments()
    checkpoint = target.with_suffix(CHECKPOINT_SUFFIX)
    if target.exists() and not force:
        raise ValueError(f"There is {str(target)!r} already: choose another file, or replace it by --force.")
    if checkpoint.exists() and not (resume or force):
        raise ValueError(
            f"There is an unfinished training in {str(checkpoint)!r}: go on with --resume, or replace it by --force."
        )
    if resume and not checkpoint.exists():
        raise ValueError(f"There is no training to resume: no {str(checkpoint)!r}.")
    saved = load_checkpoint(checkpoint, arguments) if resume else None

    from training.vec_env import sb3_vec_env

    kind = {**split_layout(ids[0])[1], **make_kwargs}.get("action", "continuous")
    make_kwargs |= {"action": "discrete"} if hyperparameters.discrete and kind == "continuous" else {}
    env = sb3_vec_env(ids, num_envs, even_strata=even_strata, reward_scale=hyperparameters.reward_scale, **make_kwargs)
    told = "Stopped at once: of the last steps nothing is kept."
    try:
        with use_one_thread(), _progress_bar(progress) as bar, defer_signals() as received:
            settings = _fit_to_run(hyperparameters, num_envs, steps)
            if retraining is None:
                model = _make_model(algo, env, seed, settings, hyperparameters.policy, device)
            else:
                model = _continue_model(retraining, algo, env, seed, settings, device)
            if saved is not None:
                model.get_env().reset()
                restore_model(model, saved)
            callback = _make_callback(bar, steps, checkpoint, arguments, checkpoint_interval, received)
            model.learn(steps - model.num_timesteps, callback=callback, reset_num_timesteps=saved is None)
            told = callback.kept
            if not told:
                _save_ego(model, target, callback)
                checkpoint.unlink(missing_ok=True)
    except KeyboardInterrupt:
        if told:
            raise TrainingInterrupted(told) from None
    finally:
        env.close()
    return target


def _save_ego(model: Any, target: Path, callback: Any) -> None:
    """Write a trained ego; where that fails, a checkpoint keeps the training and the OSError says so."""
    content = io.BytesIO()
    model.save(content)
    try:
        with replace_file(target) as draft:
            draft.write_bytes(content.getvalue())
    except OSError as error:
        raise OSError(f"Cannot write {str(target)!r}: {error.strerror or error}. {callback.keep()}") from error


def _make_model(
    algo: str, env: Any, seed: int, settings: Mapping[str, Any], policy: Mapping[str, Any], device: str
) -> Any:
    """Return a new model; ReLU is the activation of its networks unless `policy` names another."""
    import stable_baselines3
    from gymnasium.spaces import Dict, Discrete
    from stable_baselines3.common.preprocessing import is_image_space
    from torch import nn

    space = env.observation_space
    name = "MultiInputPolicy" if isinstance(space, Dict) else "CnnPolicy" if is_image_space(space) else "MlpPolicy"
    device = device if name != "MlpPolicy" else "cpu"  # on which small networks learn sooner, as SB3 says too
    if isinstance(env.action_space, Discrete) and not (HYPERPARAMETERS[algo].discrete or algo in ("ppo", "a2c")):
        raise ValueError(f"Expected continuous actions (--action) with {algo}; ppo, a2c and dqn take discrete ones.")
    if isinstance(space, Dict) and "train_freq" in settings:  # for which SB3 has returns of one step only
        settings = {name: value for name, value in settings.items() if name != "n_steps"}
    algorithm = getattr(stable_baselines3, algo.upper())  # its classes are named so
    policy = {"activation_fn": nn.ReLU, **policy}
    return algorithm(name, env, policy_kwargs=policy, seed=seed, device=device, **settings)


def _continue_model(
    retraining: Retraining, algo: str, env: Any, seed: int, settings: Mapping[str, Any], device: str
) -> Any:
    """Return the model of an ego to train on, in an environment that draws its failures too."""
    from agents.saved_ego import load_saved_ego

    saved = load_saved_ego(retraining.ego, None)
    check_retrainable(saved, algo, env)
    env.set_attr("space", retraining.mix(env.get_attr("space")[0]))
    model = _make_model(algo, env, seed, continue_settings(settings), saved.policy_kwargs, device)
    restore_parameters(model, saved)
    return model


def check_retrainable(saved: Any, algo: str, env: Any) -> None:
    """Refuse an ego, an `agents.SavedEgo`, that cannot be trained on by an algorithm in an environment."""
    name = repr(str(saved.path))
    if saved.algorithm != algo:
        raise ValueError(f"Expected an ego trained by {algo}, got {name}, trained by {saved.algorithm}.")
    if saved.statistics is not None:
        raise ValueError(f"Cannot train {name} on: it was trained behind VecNormalize, train-ego has none.")
    for what in ("observation_space", "action_space"):
        own, given = getattr(saved.policy, what), getattr(env, what)  # both have these two
        if own != given:
            raise ValueError(f"Cannot train {name} on: its {what} is {own}, that of the environment is {given}.")


def restore_parameters(model: Any, saved: Any) -> None:
    """Give a new model of equal networks the networks, optimisers and entropy coefficient of an `agents.SavedEgo`."""
    from stable_baselines3.common.save_util import load_from_zip_file, recursive_getattr

    try:
        # settings, which hold pickles, are not opened; tensors are read as tensors only
        _, parameters, variables = load_from_zip_file(saved.path, device="cpu", load_data=False)
        model.set_parameters(parameters, exact_match=True, device="cpu")
        for name, value in (variables or {}).items():
            recursive_getattr(model, name).data.copy_(value)
    except (KeyError, RuntimeError, ValueError, AttributeError, TypeError) as error:
        words = str(error).partition("\n")[0]
        raise ValueError(
            f"Cannot train {str(saved.path)!r} on: it has not all that a training needs: {words}"
        ) from error


def continue_settings(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments of an algorithm that goes on: it explores as at the end of a training and learns at once."""
    changed = dict(arguments)
    if "learning_starts" in changed:
        changed["learning_starts"] = 0
    if "exploration_final_eps" in changed:
        changed["exploration_initial_eps"] = changed["exploration_final_eps"]
    return changed


def _fit_to_run(hyperparameters: Hyperparameters, num_envs: int, steps: int) -> dict[str, Any]:
    """Return arguments of the algorithm, adapted to a run that may be smaller than the settings assume."""
    arguments = dict(hyperparameters.settings)
    if "train_freq" in arguments:  # off-policy: keep every transition, learn after a few steps
        arguments["buffer_size"] = max(steps + num_envs, 1024)
        arguments["learning_starts"] = min(10 * num_envs, steps // 10)
    elif "batch_size" in arguments:
        arguments["batch_size"] = min(arguments["batch_size"], arguments["n_steps"] * num_envs)
    if hyperparameters.noise:
        from stable_baselines3.common.noise import NormalActionNoise

        arguments["action_noise"] = NormalActionNoise(np.zeros(2), np.full(2, hyperparameters.noise))
    return arguments


def _prepare_target(out: Path) -> Path:
    """Return the file to write, with its folder made; a ValueError if it cannot be written."""
    target = out if out.suffix == ".zip" or not out.name else out.with_name(f"{out.name}.zip")
    for folder in filter(Path.is_dir, (out, target)):
        raise ValueError(f"Expected a file to write, got the folder {str(folder)!r}; name a .zip.")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"Cannot make the folder {str(target.parent)!r}: {error}.") from error
    if not os.access(target if target.exists() else target.parent, os.W_OK):
        raise ValueError(f"Cannot write {str(target)!r}: no permission.")
    return target


def _progress_bar(show: bool) -> Progress:
    """Return a bar on standard error, narrow where the terminal is."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    time_left = TimeRemainingColumn(elapsed_when_finished=True)
    narrow = (BarColumn(bar_width=10), TextColumn("{task.completed:,.0f} steps"), time_left)
    columns = (
        TextColumn("training"),
        BarColumn(),
        TextColumn("{task.completed:,.0f}/{task.total:,.0f} steps"),
        time_left,
        TextColumn("{task.description}"),
    )
    return Progress(*(columns if console.width >= NARROW_TERMINAL else narrow), console=console, disable=not show)


def _make_callback(
    bar: Progress, steps: int, path: Path, arguments: Mapping[str, Any], interval: float, received: Sequence[int]
) -> Any:
    """Return the callback that advances the bar, and writes a checkpoint where a rollout begins.

    It does so after an interval, and when a signal was received, which ends the training.
    """
    from stable_baselines3.common.callbacks import BaseCallback

    task, crashes = bar.add_task("", total=steps), deque[bool](maxlen=RECENT)

    class Callback(BaseCallback):
        written, kept = time.monotonic(), ""

        def keep(self) -> str:
            """Write a checkpoint, if there is room, and return what to say of it."""
            try:
                save_checkpoint(path, arguments, self.model)
            except OSError as error:
                why = error.strerror or error
                warnings.warn(f"Cannot write {str(path)!r}: {why}; what is trained is not kept.", stacklevel=2)
                return "The last steps are not kept."
            finally:
                self.written = time.monotonic()
            n = self.model.num_timesteps
            return f"{n:,} of {steps:,} steps are kept in {str(path)!r}: go on by the same command with --resume."

        def _on_rollout_start(self) -> None:
            if received:
                self.kept = f"Stopped: {self.keep()}"
            elif time.monotonic() - self.written >= interval:
                self.keep()

        def _on_step(self) -> bool:
            if not bar.disable:
                crashes.extend(bool(info["collision"]) for info in self.locals["infos"] if "collision" in info)
                episodes, words = self.model.ep_info_buffer, list[str]()
                if episodes:
                    words.append(f"return {sum(end['r'] for end in episodes) / len(episodes):.1f}")
                if crashes:
                    words.append(f"collisions {100 * sum(crashes) / len(crashes):.1f} %")
                bar.update(task, completed=min(self.model.num_timesteps, steps), description=", ".join(words))
            return not self.kept

    return Callback()
