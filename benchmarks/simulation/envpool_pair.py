"""How fast is it beside EnvPool's HighwayEnv, which is C++? The same two cars, side by side in turn, on one core.

    python -m benchmarks.simulation.throughput --only-envpool --out benchmarks/results/envpool.json

`make bench` measures it too, where EnvPool is installed. Both move two vehicles by ticks of 0.1 s for 20 s, 1,024
episodes at once, and show a policy HighwayEnv's `kinematics` (5, 5). EnvPool's ego acts by meta-actions only.
"""

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import rare_envs
from benchmarks import seconds
from rare_envs.startup import use_one_thread

EPISODES = 1024
HORIZON = 20
"""Length of an episode [s]."""
TICKS_PER_SECOND = 10
OURS = "rare_envs/CarFollowing-v0"


def is_installed() -> bool:
    """Return whether EnvPool is there."""
    return find_spec("envpool") is not None


def make_envpool(decisions_per_second: int) -> Any:
    """Return EnvPool's two cars on a lane, one thread."""
    import envpool

    steps = HORIZON * decisions_per_second
    return envpool.make_gymnasium(
        "HighwayFast-v0",
        num_envs=EPISODES,
        num_threads=1,
        vehicles_count=1,
        lanes_count=1,
        simulation_frequency=TICKS_PER_SECOND,
        policy_frequency=decisions_per_second,
        duration=steps,
        max_episode_steps=steps,
    )


def measure_steps(decisions_per_second: int, rounds: int, steps: int = 100) -> dict[str, list[float]]:
    """Return steps per second of the batch, ours and EnvPool's: meta-actions each second, or an action each tick."""
    meta = decisions_per_second == 1
    kind = {"action": "meta"} if meta else {}
    ours = gym.make_vec(OURS, EPISODES, observation="kinematics", horizon=float(HORIZON), **kind)
    rng = np.random.default_rng(0)
    choices = rng.integers(0, 5, (steps, EPISODES)).astype(np.int32)
    actions = choices if meta else rng.uniform(-0.3, 0.3, (steps, EPISODES, 2)).astype(np.float32)
    return _measure_pair(ours, actions, make_envpool(decisions_per_second), choices, rounds)


def _measure_pair(
    ours: Any, actions: NDArray[Any], theirs: Any, choices: NDArray[Any], rounds: int
) -> dict[str, list[float]]:
    def drive(env: Any, chosen: NDArray[Any]) -> Callable[[], None]:
        env.reset()

        def run() -> None:
            for action in chosen:
                env.step(action)

        return run

    pair = {"ours": drive(ours, actions), "theirs": drive(theirs, choices)}
    pair["ours"]()  # compiles
    return _time_in_turn({name: (choices.size, run) for name, run in pair.items()}, rounds)


def _time_in_turn(works: dict[str, tuple[int, Callable[[], object]]], rounds: int) -> dict[str, list[float]]:
    """Return how much of each work, (amount, function), is done per second, one after the other in each round."""
    rates = {name: list[float]() for name in works}
    for _ in range(rounds):
        for name, (amount, work) in works.items():
            rates[name].append(amount / seconds(work))
    return rates


def measure_policy(decisions_per_second: int, rounds: int) -> dict[str, list[float]]:
    """Return simulated seconds per second while a policy of the default size drives.

    It is a DQN with meta-actions each second on `kinematics`; each tick ours is a PPO on `features` (11,), compiled.
    """
    import torch
    from stable_baselines3 import DQN, PPO

    meta = decisions_per_second == 1
    kind = {"observation": "kinematics", "action": "meta"} if meta else {}
    env = gym.make(OURS, **kind)
    model = DQN("MlpPolicy", env, device="cpu", seed=0, buffer_size=1) if meta else PPO("MlpPolicy", env, device="cpu")
    problem = rare_envs.DrivingProblem(OURS, ego=model, horizon=float(HORIZON), **kind)
    x = problem.base.sample(4 * EPISODES, np.random.default_rng(0))
    problem.evaluate(x[:1])  # compiles
    sizes = ((25, 64), (64, 64), (64, 5))
    layers = [torch.nn.Linear(*size) for size in sizes]
    theirs = make_envpool(decisions_per_second)

    def drive() -> None:
        seen, _ = theirs.reset()
        for _ in range(HORIZON * decisions_per_second):
            hidden = layers[1](layers[0](torch.from_numpy(seen).flatten(1)).relu()).relu()
            seen, *_ = theirs.step(layers[2](hidden).argmax(dim=1).numpy().astype(np.int32))

    with torch.inference_mode():
        ours = (HORIZON * len(x), lambda: problem.evaluate(x))
        return _time_in_turn({"ours": ours, "theirs": (HORIZON * EPISODES, drive)}, rounds)


@use_one_thread()
def measure_all(rounds: int = 5) -> dict[str, dict[str, list[float]]]:
    """Return rates by name: decisions of a second and of a tick, of a batch that is stepped and of policies."""
    return {
        "envpool_step_decision": measure_steps(1, rounds),
        "envpool_step_tick": measure_steps(TICKS_PER_SECOND, rounds),
        "envpool_policy_decision": measure_policy(1, rounds),
        "envpool_policy_tick": measure_policy(TICKS_PER_SECOND, rounds),
    }
