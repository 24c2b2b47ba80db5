"""A GPU simulates what the CPU does: the same collisions, f to rounding, for every scenario and every kind of ego."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from stable_baselines3 import DQN, PPO

import agents
import rare_envs
import samplers
import training
from rare_envs.simulation.cuda_graphs import RecordedRollouts
from rare_envs.simulation.world import rollout
from samplers.evaluate import Evaluator
from training.data import scenes_of, synthetic_traffic
from training.imitation.config import Config
from training.imitation.train import make_learner, prepare_data, train_learner

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")]
CAR_FOLLOWING, CUT_IN, HIGHWAY = "rare_envs/CarFollowing-v0", "rare_envs/CutIn-v0", "rare_envs/Highway-v0"
ROUNDING = 1e-3
"""Greatest difference of f [s]: sums and tangents round differently, and a short time to collision is a ratio."""


def of_both(env_id: str, rows: int, **settings: Any) -> tuple[Any, Any, NDArray[np.float64]]:
    """Return a problem on the CPU and one on the GPU, both by torch, and scenarios that often fail."""
    on_cpu = rare_envs.DrivingProblem(env_id, core="torch", **settings)
    on_gpu = rare_envs.DrivingProblem(env_id, device="cuda", **settings)
    x = on_cpu.base.sample(rows, np.random.default_rng(3))
    if env_id != HIGHWAY:  # the whole box instead of ordinary traffic
        low, high = np.array([(each.low, each.high) for each in on_cpu.world.scenario.parameters]).T
        x[:, : len(low)] = np.random.default_rng(4).uniform(low, high, (rows, len(low)))
    return on_cpu, on_gpu, x


def assert_same(one: NDArray[np.float64], other: NDArray[np.float64]) -> None:
    """Compare values of f; a rollout may differ where it just touches, or where a decision jumps."""
    apart = np.abs(one - other) > ROUNDING
    assert apart.mean() <= 2e-3, (apart.sum(), len(one))
    assert ((one < 0.0) != (other < 0.0)).mean() <= 1e-3


def ppo(env_id: str, **settings: Any) -> Any:
    return PPO("MlpPolicy", gym.make(env_id), device="cpu", seed=0, **settings)


EGOS: dict[str, Callable[[str], Any]] = {
    "idm": lambda env_id: "idm",
    "human": lambda env_id: "human",
    "ppo": ppo,
    "ppo of rectifiers": lambda env_id: ppo(env_id, policy_kwargs={"activation_fn": torch.nn.ReLU}),
    "a stack": lambda env_id: agents.load_ego("noisy:idm"),
    "a learned driver": lambda env_id: "mgail",
    "a function": lambda env_id: lambda seen: np.tile([0.1, 0.0], (len(seen), 1)),
    "a module": lambda env_id: torch.nn.Linear(gym.make(env_id).observation_space.shape[0], 2),  # type: ignore[index]
}


@pytest.mark.parametrize("ego", EGOS)
@pytest.mark.parametrize("env_id", [CAR_FOLLOWING, CUT_IN, "rare_envs/CutIn-v1", "rare_envs/HardBrake-v0"])
def test_scripts_end_alike(env_id: str, ego: str) -> None:
    torch.manual_seed(0)
    on_cpu, on_gpu, x = of_both(env_id, 1000, ego=EGOS[ego](env_id))
    f = on_cpu.evaluate(x)
    assert_same(f, on_gpu.evaluate(x))
    assert (f < 0.0).any()


@pytest.mark.parametrize("drivers", ["mgail?rules=0", "mgail", "gail", "idm+mobil"])
@pytest.mark.parametrize("measure", ["ttc", "lidar_ttc", "clearance"])
def test_the_highway_ends_alike(drivers: str, measure: str) -> None:
    on_cpu, on_gpu, x = of_both(HIGHWAY, 200, drivers=drivers, measure=measure)
    assert_same(on_cpu.evaluate(x), on_gpu.evaluate(x))


@pytest.mark.parametrize("collisions", ["ego", "any"])
def test_terms_gradients_and_crashes_are_those_of_the_cpu(collisions: str) -> None:
    on_cpu, on_gpu, x = of_both(HIGHWAY, 64, collisions=collisions, measure="lidar_ttc")
    for gamma in (0.0, 1.0):
        of_cpu, of_gpu = (problem.terms(x, gamma) for problem in (on_cpu, on_gpu))
        assert of_cpu.names == of_gpu.names
        assert_same(of_cpu.values.ravel(), of_gpu.values.ravel())
        row, term = np.arange(len(x)), of_cpu.least
        ticks = of_cpu.ticks[row, term]
        slopes = [problem.gradient(x, term, ticks, gamma).values for problem in (on_cpu, on_gpu)]
        scale = np.abs(slopes[0]).max()
        assert np.nanmax(np.abs(slopes[0] - slopes[1])) < 0.02 * scale
    kinds = [problem.crash_kinds(x) for problem in (on_cpu, on_gpu)]
    assert np.mean([one == other for one, other in zip(*kinds, strict=True)]) > 0.95


def test_discrete_actions_and_a_camera_go_through_the_cpu() -> None:
    env = gym.make(CAR_FOLLOWING, action="meta")
    model = DQN("MlpPolicy", env, device="cpu", buffer_size=10, seed=0)
    on_cpu, on_gpu, x = of_both(CAR_FOLLOWING, 200, ego=model, action="meta")
    assert_same(on_cpu.evaluate(x), on_gpu.evaluate(x))
    on_cpu, on_gpu, x = of_both(CAR_FOLLOWING, 8, ego="vision")
    # bytes of pixels round differently, and its network differs by that from there on
    np.testing.assert_allclose(on_cpu.evaluate(x), on_gpu.evaluate(x), atol=10 * ROUNDING)


@pytest.mark.parametrize(
    ("env_id", "settings"), [(CUT_IN, {}), (HIGHWAY, {"drivers": "mgail"}), (CUT_IN, {"ego": "human"})]
)
def test_recorded_rollouts_have_the_bits_of_torch(env_id: str, settings: dict[str, Any]) -> None:
    problem = rare_envs.DrivingProblem(env_id, device="cuda", **settings)
    recorded = RecordedRollouts(problem.driver, tile=256)
    x = torch.from_numpy(problem.base.sample(200, np.random.default_rng(0))).float().cuda()
    with torch.inference_mode():
        for rows, size in ((x, 256), (x[:40], 64), (x.flip(0), 256)):
            filled = torch.cat((rows, rows[:1].expand(size - len(rows), -1)))
            expected = rollout(problem.world, problem.driver, filled).f[: len(rows)]
            assert torch.equal(recorded(problem.world, rows).f, expected)
    assert len(recorded._recordings) == 2


def test_a_policy_that_learns_is_recorded_anew() -> None:
    model = ppo(CAR_FOLLOWING)
    problem = rare_envs.DrivingProblem(CAR_FOLLOWING, ego=model, device="cuda")
    x = problem.base.sample(50, np.random.default_rng(0))
    before = problem.evaluate(x)
    with torch.no_grad():
        model.policy.action_net.bias += 1.0
    after = problem.evaluate(x)
    assert not np.array_equal(before, after)
    assert_same(after, rare_envs.DrivingProblem(CAR_FOLLOWING, ego=model, core="torch").evaluate(x))


def test_what_fails_on_a_gpu_is_named() -> None:
    model = ppo(CAR_FOLLOWING)
    with torch.no_grad():
        model.policy.action_net.bias += torch.nan
    problem = rare_envs.DrivingProblem(CAR_FOLLOWING, ego=model, device="cuda")
    x = problem.base.sample(5, np.random.default_rng(0))
    with pytest.raises(ValueError, match="Expected parameter loc"):  # as its `predict` says
        problem.evaluate(x)


class FailsLate(torch.nn.Module):
    """Goes straight on until it is closer than 30 m to its lead, and knows nothing then."""

    def forward(self, seen: torch.Tensor) -> torch.Tensor:
        near = seen[:, 3] < 0.6  # the gap over 50 m
        return torch.where(near, torch.nan, 0.0)[:, None].expand(-1, 2)


@pytest.mark.parametrize("measure", ["ttc", "lidar_ttc", "pet"])
def test_rows_that_fail_on_a_gpu_are_those_that_fail_on_the_cpu(measure: str) -> None:
    on_cpu, on_gpu, x = of_both(CAR_FOLLOWING, 60, ego=FailsLate(), measure=measure)
    expected, f = (Evaluator(problem, on_error="failure").evaluate(x) for problem in (on_cpu, on_gpu))
    assert 0 < np.isnan(expected).sum() < len(x)
    np.testing.assert_allclose(f, expected, atol=ROUNDING)


def test_threads_do_not_get_each_others_scenarios() -> None:
    problem = rare_envs.DrivingProblem(CUT_IN, device="cuda")
    parts = np.split(problem.base.sample(2000, np.random.default_rng(0)), 40)
    with ThreadPoolExecutor(4) as threads:
        together = list(threads.map(problem.evaluate, parts))
    for part, f in zip(parts, together, strict=True):
        np.testing.assert_array_equal(problem.evaluate(part), f)


def test_workers_take_a_problem_on_a_gpu_over() -> None:
    problem = rare_envs.DrivingProblem(CUT_IN, device="cuda")
    alone = samplers.estimate(problem, "mc", seed=1, max_sim=8192)
    assert samplers.estimate(problem, "mc", seed=1, max_sim=8192, workers=2).p == alone.p


@pytest.mark.parametrize("env_id", [CUT_IN, HIGHWAY])
def test_a_vector_environment_steps_alike(env_id: str) -> None:
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (30, 50, 2)).astype(np.float32)
    seen = []
    for where in ({"core": "torch"}, {"device": "cuda"}):
        env: Any = gym.make_vec(env_id, num_envs=50, vectorization_mode="vector_entry_point", **where)
        observed, total = [env.reset(seed=0)[0]], np.zeros(50)
        for action in actions:
            observation, reward, *_ = env.step(action)
            observed.append(observation)
            total += reward
        seen.append((np.stack(observed), total))
        state = env.unwrapped.export_state()
        env.unwrapped.restore_state(state)
        assert all(tensor.device.type == "cpu" for tensor in state["episode"])
    np.testing.assert_allclose(seen[0][0], seen[1][0], atol=2e-3)
    np.testing.assert_allclose(seen[0][1], seen[1][1], atol=1e-2)


def test_an_ego_is_trained_on_a_gpu_and_drives_on_the_cpu(tmp_path: Path) -> None:
    out, size = tmp_path / "ego", {"steps": 4096, "num_envs": 64}
    path = training.train_ego(CAR_FOLLOWING, out=out, progress=False, device="cuda", **size)
    f = rare_envs.DrivingProblem(CAR_FOLLOWING, ego=agents.load_ego(path)).evaluate(np.array([[20.0, 15.0, 30.0]]))
    assert np.isfinite(f).all()


@pytest.mark.parametrize("method", ["mgail", "gail"])
def test_drivers_are_trained_on_a_gpu_as_on_the_cpu(method: Any, tmp_path: Path) -> None:
    data = prepare_data(scenes_of(synthetic_traffic(), seconds=4.0))
    config = Config(method=method, epochs=1, updates=3, warm_up=1)
    trained = []
    for device in ("cpu", "cuda"):
        learner = make_learner(data, config, device=torch.device(device))
        folder = tmp_path / device
        folder.mkdir()
        trained.append(train_learner(learner, folder).cpu().state_dict())
        again = make_learner(data, config, device=torch.device(device))
        again.load(folder / "checkpoint.pt")
        assert again.update == 3
    for name, value in trained[0].items():
        torch.testing.assert_close(value, trained[1][name], atol=2e-3, rtol=1e-2)
