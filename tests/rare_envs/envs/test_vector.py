"""The batched environment: agreement with the environment of one and with rollout, and its autoreset."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

import rare_envs
from rare_envs.envs.rows_and_infos import DRAWS_IN_A_ROW
from rare_envs.envs.vector import DrivingVectorEnv, read_autoreset_mode
from rare_envs.scenarios.registry import SCENARIOS

ids = pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)
SCRIPTED_IDS = [env_id for env_id, scenario in SCENARIOS.items() if scenario.drivers is None]
scripted = pytest.mark.parametrize("env_id", SCRIPTED_IDS)  # no network, so batch sizes change no bit


class Scripted:
    """An ego with SB3's `predict`: a fixed sequence of actions, then the last one for ever."""

    def __init__(self, actions: NDArray[np.float64]) -> None:
        self.actions = actions

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> Any:
        tick = 0 if state is None else state[0]
        action = self.actions[min(tick, len(self.actions) - 1)]
        return np.repeat(action[None], len(observation), axis=0), (tick + 1,)


def scripted_actions(seed: int = 0) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    return np.stack([rng.uniform(-0.7, 1.0, 100), rng.uniform(-0.05, 0.05, 100)], axis=1)


@scripted
def test_env_vector_env_and_rollout_agree_on_the_same_x_and_actions(env_id: str) -> None:
    actions = scripted_actions()
    base = "us101-all-brakings" if "HardBrake" in env_id else None  # brakings to a standstill all end in a collision
    problem = rare_envs.DrivingProblem(env_id, ego=Scripted(actions), horizon=5.0, base=base)
    x = problem.base.sample(64, np.random.default_rng(1))
    f = problem.evaluate(x)
    assert (f == -1.0).any()
    assert (f > 0.0).any()

    batch = rare_envs.make_batch(env_id, len(x), horizon=5.0, core="torch")  # the compiled core rounds otherwise
    batch.reset(options={"x": x})
    measured = np.full(len(x), np.nan)
    observations = []
    for action in actions:
        observation, reward, terminated, truncated, infos = batch.step(np.repeat(action[None], len(x), axis=0))
        observations.append((observation, reward, infos))
        first = (terminated | truncated) & np.isnan(measured)
        measured[first] = infos["final_info"]["measure"][first] if first.any() else np.nan
    np.testing.assert_array_equal(measured, f)

    env = gym.make(env_id, horizon=5.0, core="torch")
    for row in range(8):
        env.reset(options={"x": x[row]})
        for tick, action in enumerate(actions):
            observation, reward, terminated, truncated, info = env.step(action)
            if terminated or truncated:
                assert info["measure"] == f[row]
                assert info["collision"] == (f[row] == -1.0) == terminated
                np.testing.assert_array_equal(observation, observations[tick][2]["final_obs"][row])
                break
            np.testing.assert_array_equal(observation, observations[tick][0][row])
            assert reward == pytest.approx(observations[tick][1][row], rel=1e-6)
            assert info["min_ttc"] == observations[tick][2]["min_ttc"][row]


@ids
def test_same_seed_same_episodes(env_id: str) -> None:
    runs = []
    for _ in range(2):
        batch = rare_envs.make_batch(env_id, 16, horizon=3.0)
        observation, _ = batch.reset(seed=4)
        rows = [observation]
        batch.action_space.seed(0)
        for _ in range(50):
            rows.append(batch.step(batch.action_space.sample())[0])
        runs.append(np.array(rows))
    np.testing.assert_array_equal(*runs)


@ids
def test_scenarios_are_those_of_one_draw_after_the_other(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = []
    for in_a_row in (DRAWS_IN_A_ROW, ()):
        monkeypatch.setattr("rare_envs.envs.rows_and_infos.DRAWS_IN_A_ROW", in_a_row)
        batch = rare_envs.make_batch(env_id, 4, horizon=0.5)
        _, infos = batch.reset(seed=6)
        rows = [infos["x"]]
        for tick in range(12):
            if tick == 8:  # the generator goes on, and part of the drawn scenarios are given
                given = batch.space.low[: batch.space.sizes[0]]
                rows.append(batch.reset(options={batch.space.names[0]: given})[1]["x"])
            if tick == 9:
                kept = batch.export_state()
                batch = rare_envs.make_batch(env_id, 4, horizon=0.5)
                batch.reset(seed=1)
                batch.restore_state(kept)
            rows.append(batch.step(np.zeros((4, 2), np.float32))[-1]["x"])
        runs.append((np.array(rows), batch.np_random.bit_generator.state))
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    assert runs[0][1] == runs[1][1]


@ids
def test_vector_env_replaces_ended_episodes_in_the_same_step(env_id: str) -> None:
    batch = gym.make_vec(env_id, num_envs=32)  # the batched entry point is the default
    assert isinstance(batch.unwrapped, DrivingVectorEnv)
    assert batch.metadata["autoreset_mode"] == gym.vector.AutoresetMode.SAME_STEP
    batch.reset(seed=0)
    ended = 0
    for _ in range(120):
        x = batch.unwrapped._x.copy()
        observation, _, terminated, truncated, infos = batch.step(np.tile(np.array([0.4, 0.0], np.float32), (32, 1)))
        done = terminated | truncated
        assert observation in batch.observation_space
        np.testing.assert_array_equal((batch.unwrapped._x != x).any(axis=1), done)
        if done.any():
            np.testing.assert_array_equal(infos["_final_info"], done)
            assert [row is not None for row in infos["final_obs"]] == done.tolist()
            np.testing.assert_array_equal(infos["final_info"]["collision"][done], terminated[done])
            np.testing.assert_array_equal(infos["final_info"]["x"][done], x[done])
            ended += int(done.sum())
    assert ended >= 32


@scripted
def test_episodes_after_a_replacement_are_those_of_the_single_env(env_id: str) -> None:
    """Nothing of an ended episode, not its clock and not its least time to collision, is left in the next."""
    batch, env = rare_envs.make_batch(env_id, 6, horizon=3.0), gym.make(env_id, horizon=3.0)
    observation, infos = batch.reset(seed=5)
    rng = np.random.default_rng(0)
    x, given = infos["x"].copy(), [[] for _ in range(6)]  # type: ignore[var-annotated]
    lives = np.zeros(6, dtype=int)
    for _ in range(120):
        actions = np.stack([rng.uniform(-0.2, 1.0, 6), rng.uniform(-0.2, 0.2, 6)], axis=1)
        for row in range(6):
            given[row].append(actions[row])
        observation, reward, terminated, truncated, infos = batch.step(actions)
        for row in np.flatnonzero(terminated | truncated):
            env.reset(options={"x": x[row]})
            for action in given[row]:
                last = env.step(action)
            final = infos["final_info"]
            np.testing.assert_array_equal(last[0], infos["final_obs"][row])
            assert last[1] == pytest.approx(reward[row], rel=1e-6)
            assert last[2:4] == (terminated[row], truncated[row])
            assert last[4]["measure"] == final["measure"][row]
            assert last[4]["min_ttc"] == final["min_ttc"][row]
            assert last[4]["collision_type"] == final["collision_type"][row]
            x[row], given[row], lives[row] = infos["x"][row], [], lives[row] + 1
            np.testing.assert_array_equal(env.reset(options={"x": x[row]})[0], observation[row])
    assert lives.min() >= 3


@scripted
def test_episodes_replaced_in_the_next_step_are_those_of_the_single_env(env_id: str) -> None:
    """The step after an end starts an episode: its action does not count, its reward is 0, and nothing moves."""
    batch = rare_envs.make_batch(env_id, 3, horizon=0.8, autoreset_mode="NextStep")
    env = gym.make(env_id, horizon=0.8)
    observation, infos = batch.reset(seed=5)
    rng = np.random.default_rng(0)
    over, ends = np.zeros(3, dtype=bool), 0
    for row in range(3):
        np.testing.assert_array_equal(env.reset(options={"x": infos["x"][row]})[0], observation[row])
    x, given = infos["x"].copy(), [[] for _ in range(3)]  # type: ignore[var-annotated]
    for _ in range(24):
        actions = np.stack([rng.uniform(-0.2, 1.0, 3), rng.uniform(-0.2, 0.2, 3)], axis=1)
        actions[over] = np.nan  # which does not count
        observation, reward, terminated, truncated, infos = batch.step(actions)
        assert "final_obs" not in infos
        np.testing.assert_array_equal(infos["_reward_terms"], ~over)
        for row in range(3):
            if over[row]:
                assert (reward[row], terminated[row], truncated[row]) == (0.0, False, False)
                x[row], given[row] = infos["x"][row], []
            else:
                given[row].append(actions[row])
            last = env.reset(options={"x": x[row]})[0], 0.0, False, False, {}
            for action in given[row]:
                last = env.step(action)
            np.testing.assert_array_equal(last[0], observation[row])
            assert last[1] == pytest.approx(reward[row], rel=1e-6)
            assert last[2:4] == (terminated[row], truncated[row])
            if last[2] or last[3]:
                assert infos["_measure"][row] and infos["measure"][row] == last[4]["measure"]
                ends += 1
        over = terminated | truncated
    assert ends >= 6


def test_without_autoreset_the_caller_resets_the_rows_that_ended() -> None:
    batch = rare_envs.make_batch("rare_envs/CutIn-v0", 3, horizon=0.2, autoreset_mode=gym.vector.AutoresetMode.DISABLED)
    with pytest.raises(RuntimeError, match="of all episodes before one with reset_mask"):
        batch.reset(options={"reset_mask": np.array([True, False, False])})
    _, infos = batch.reset(seed=0)
    still = np.zeros((3, 2), np.float32)
    batch.step(still)
    *_, truncated, _ = batch.step(still)
    assert truncated.all()
    with pytest.raises(RuntimeError, match=r"episodes \[0, 1, 2\] have ended"):
        batch.step(still)
    mask = np.array([True, False, True])
    _, after = batch.reset(options={"reset_mask": mask, "cut_in_gap": [9.0, 12.0]})
    assert after["scenario"]["cut_in_gap"][mask].tolist() == [9.0, 12.0]
    np.testing.assert_array_equal(after["_x"], mask)
    np.testing.assert_array_equal(after["x"][1], infos["x"][1])
    with pytest.raises(RuntimeError, match=r"episodes \[1\] have ended"):
        batch.step(still)
    batch.reset(options={"reset_mask": ~mask})
    *_, truncated, _ = batch.step(still)
    assert not truncated.any()


@pytest.mark.parametrize("mode", gym.vector.AutoresetMode)
def test_a_mode_is_read_by_itself_and_by_gymnasiums_word(mode: gym.vector.AutoresetMode) -> None:
    assert read_autoreset_mode(mode) is read_autoreset_mode(mode.value) is mode
    for other in (mode.name, mode.value.lower(), None):
        with pytest.raises(ValueError, match=f"autoreset_mode {other!r}; expected one of 'NextStep', 'SameStep', 'Dis"):
            read_autoreset_mode(other)  # type: ignore[arg-type]


@pytest.mark.parametrize("mask", [np.zeros(2, bool), np.ones(3, bool), np.array([1, 0])])
def test_a_wrong_mask_or_mode_is_refused(mask: np.ndarray) -> None:
    batch = rare_envs.make_batch("rare_envs/CutIn-v0", 2)
    batch.reset(seed=0)
    with pytest.raises(ValueError, match=r"reset_mask boolean of shape \(2,\)"):
        batch.reset(options={"reset_mask": mask})
    with pytest.raises(ValueError, match=r"autoreset_mode 'later'; expected one of 'NextStep', 'SameStep', 'Disabled'"):
        rare_envs.make_batch("rare_envs/CutIn-v0", 2, autoreset_mode="later")
