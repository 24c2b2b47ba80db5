"""Environments of one and batched: their agreement, autoreset, infos, reset options, and scenarios drawn ahead."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import rare_envs
from rare_envs.distributions import BetaDistribution
from rare_envs.envs.parallel import AgentsVectorEnv
from rare_envs.envs.rows_and_infos import DRAWS_IN_A_ROW, ROWS_AHEAD, DrawsAhead
from rare_envs.envs.vector import DrivingVectorEnv
from rare_envs.scenarios.registry import SCENARIOS

ids = pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)
SCRIPTED_IDS = [env_id for env_id, scenario in SCENARIOS.items() if scenario.drivers is None]
scripted = pytest.mark.parametrize("env_id", SCRIPTED_IDS)  # no network, so batch sizes change no bit


@ids
def test_scenarios_are_those_of_one_draw_after_the_other(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = []
    for in_a_row in (DRAWS_IN_A_ROW, ()):
        monkeypatch.setattr("rare_envs.envs.rows_and_infos.DRAWS_IN_A_ROW", in_a_row)
        batch = gym.make_vec(env_id, 4, horizon=0.5)
        _, infos = batch.reset(seed=6)
        rows = [infos["x"]]
        for tick in range(12):
            if tick == 8:  # the generator goes on, and part of the drawn scenarios are given
                given = batch.space.low[: batch.space.sizes[0]]
                rows.append(batch.reset(options={batch.space.names[0]: given})[1]["x"])
            if tick == 9:
                kept = batch.export_state()
                batch = gym.make_vec(env_id, 4, horizon=0.5)
                batch.reset(seed=1)
                batch.restore_state(kept)
            rows.append(batch.step(np.zeros((4, 2), np.float32))[-1]["x"])
        runs.append((np.array(rows), batch.np_random.bit_generator.state))
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    assert runs[0][1] == runs[1][1]


@scripted
@pytest.mark.parametrize("mode", [gym.vector.AutoresetMode.SAME_STEP, gym.vector.AutoresetMode.NEXT_STEP])
def test_episodes_after_a_replacement_are_those_of_the_single_env(env_id: str, mode: Any) -> None:
    """Nothing of an ended episode, not its clock and not its least time to collision, is left in the next.

    If it begins in the step after an end, that step's action does not count, its reward is 0, and nothing moves.
    """
    later = mode is gym.vector.AutoresetMode.NEXT_STEP
    batch = gym.make_vec(env_id, 4, horizon=3.0, **({"autoreset_mode": mode} if later else {}))
    assert isinstance(batch.unwrapped, DrivingVectorEnv)  # the batched entry point is the default
    assert batch.metadata["autoreset_mode"] == mode
    env, rng, lives = gym.make(env_id, horizon=3.0), np.random.default_rng(0), np.zeros(4, dtype=int)
    x, given = batch.reset(seed=5)[1]["x"].copy(), [[] for _ in range(4)]  # type: ignore[var-annotated]
    over = np.zeros(4, dtype=bool)
    for _ in range(110):
        actions = np.stack([rng.uniform(-0.2, 1.0, 4), rng.uniform(-0.2, 0.2, 4)], axis=1)
        actions[over] = np.nan
        observation, reward, terminated, truncated, infos = batch.step(actions)
        ended, begun = terminated | truncated, over if later else terminated | truncated
        if later:
            np.testing.assert_array_equal(infos["_reward_terms"], ~over)
            np.testing.assert_array_equal(reward[over], 0.0)
            assert "final_obs" not in infos and not (ended & over).any()
        for row in np.flatnonzero(~over):
            given[row].append(actions[row])
        for row in np.flatnonzero(ended):
            env.reset(options={"x": x[row]})
            for action in given[row]:
                last = env.step(action)
            seen, told = (observation, infos) if later else (infos["final_obs"], infos["final_info"])
            np.testing.assert_array_equal(last[0], seen[row])
            assert last[1] == pytest.approx(reward[row], rel=1e-6)
            assert last[2:4] == (terminated[row], truncated[row])
            assert [last[4][name] == told[name][row] for name in ("measure", "min_ttc", "collision_type")] == [True] * 3
        for row in np.flatnonzero(begun):
            x[row], given[row], lives[row] = infos["x"][row], [], lives[row] + 1
            np.testing.assert_array_equal(env.reset(options={"x": x[row]})[0], observation[row])
        over = ended & later
    assert lives.min() >= 3


def test_without_autoreset_the_caller_resets_the_rows_that_ended() -> None:
    batch = gym.make_vec("rare_envs/CutIn-v0", 3, horizon=0.2, autoreset_mode=gym.vector.AutoresetMode.DISABLED)
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


def test_each_seed_of_a_list_is_that_of_a_single_environment() -> None:
    """It draws what the single one draws, at the start and after an end, behind others too."""
    batch, still = gym.make_vec("rare_envs/CutIn-v0", 3, horizon=0.1), np.zeros((3, 2), np.float32)
    singles, seeds = [gym.make("rare_envs/CutIn-v0") for _ in range(3)], [5, 5, 9]
    first = [env.reset(seed=seed)[1]["x"] for env, seed in zip(singles, seeds, strict=True)]
    np.testing.assert_array_equal(batch.reset(seed=seeds)[1]["x"], first)
    for _ in range(2):
        np.testing.assert_array_equal(batch.step(still)[-1]["x"], [env.reset()[1]["x"] for env in singles])
        kept = batch.export_state()
        batch.reset(seed=0)
        batch.restore_state(kept)
    mask = np.array([True, False, False])
    batch.reset(seed=[9, 9, None], options={"reset_mask": mask})
    after = [env.reset(seed=seed)[1]["x"] for env, seed in zip(singles, (9, None, None), strict=True)]
    np.testing.assert_array_equal(batch._x[0], after[0])
    with pytest.raises(ValueError, match="one seed for each of 3 environments, got 2"):
        batch.reset(seed=[1, 2])


@pytest.mark.parametrize("mask", [np.zeros(2, bool), np.ones(3, bool), np.array([1, 0])])
def test_a_wrong_mask_or_mode_is_refused(mask: np.ndarray) -> None:
    batch = gym.make_vec("rare_envs/CutIn-v0", 2)
    batch.reset(seed=0)
    with pytest.raises(ValueError, match=r"reset_mask boolean of shape \(2,\)"):
        batch.reset(options={"reset_mask": mask})
    with pytest.raises(ValueError, match=r"autoreset_mode 'later'; expected one of 'NextStep', 'SameStep', 'Disabled'"):
        gym.make_vec("rare_envs/CutIn-v0", 2, autoreset_mode="later")


def test_vehicles_that_begin_in_each_other_are_refused() -> None:
    """A cutter of 5 m whose rear is 10 m behind the ego's front has a lead whose rear is lead_gap - 5 m before it."""
    apart, touching = ({"cut_in_gap": -10.0, "lead_gap": gap} for gap in (5.1, 4.9))
    batches = AgentsVectorEnv("rare_envs/CutIn-v1", 2), gym.make_vec("rare_envs/CutIn-v1", 2)
    for env in (gym.make("rare_envs/CutIn-v1"), rare_envs.parallel_env("rare_envs/CutIn-v1"), *batches):
        env.reset(seed=0, options=apart)
        with pytest.raises(ValueError, match="vehicles apart at the start, got the lead in the ego"):
            env.reset(seed=0, options=touching)
    for env in batches:
        with pytest.raises(ValueError, match=r"the lead in the ego \(row 1\)"):
            env.reset(seed=0, options={"cut_in_gap": -10.0, "lead_gap": np.array([5.1, 4.9])})


def test_others_are_drawn_again_where_a_given_value_puts_vehicles_into_each_other() -> None:
    """One in five drawn lead gaps is under 5 m."""
    env = gym.make_vec("rare_envs/CutIn-v1", 200)
    _, info = env.reset(seed=0, options={"cut_in_gap": -10.0})
    assert (info["scenario"]["cut_in_gap"] == -10.0).all() and (info["scenario"]["lead_gap"] > 5.0).all()
    assert not info["collision"].any()
    batch, singles = gym.make_vec("rare_envs/CutIn-v1", 8), [gym.make("rare_envs/CutIn-v1") for _ in range(8)]
    for seeds in (range(8), [None] * 8):  # the draws of a row do not depend on what others draw again
        _, together = batch.reset(seed=None if None in seeds else list(seeds), options={"cut_in_gap": -10.0})
        alone = [env.reset(seed=seed, options={"cut_in_gap": -10.0}) for env, seed in zip(singles, seeds, strict=True)]
        np.testing.assert_array_equal(together["x"], [info["x"] for _, info in alone])


BETA = BetaDistribution([2.0, 0.5], [2.0, 3.0], [0.0, 1.0], [1.0, 4.0])


@pytest.mark.parametrize("kind", [np.random.PCG64, np.random.MT19937])
def test_a_generator_that_others_draw_from_too_is_not_put_back(kind: type[np.random.BitGenerator]) -> None:
    """Their draws would come again."""
    ahead, rng = DrawsAhead(BETA), np.random.Generator(kind(3))
    ahead.sample(1, rng)
    others = rng.random(5)
    ahead.settle()
    assert not np.isin(rng.random(10 * ROWS_AHEAD), others).any()


def spare(step: Any) -> Any:
    """A reward of the user's."""
    return 0.05 * step.speed - 10.0 * step.collision


WEIGHTS = {"speed": 1.0, "effort": -0.1, "lane": -0.5, "risk": -1.0, "headway": -0.5, "collision": -30.0}


@pytest.mark.parametrize("reward", [spare, WEIGHTS, f"{__name__}:spare"], ids=["function", "weights", "name"])
@pytest.mark.parametrize("action", ["continuous", "meta"])
def test_a_reward_of_ones_own_is_the_same_in_one_environment_and_in_a_batch(reward: Any, action: str) -> None:
    batch = gym.make_vec("rare_envs/CutIn-v0", 3, reward=reward, action=action)
    batch.reset(seed=[0, 1, 2])
    single = gym.make("rare_envs/CutIn-v0", reward=reward, action=action)
    standard = gym.make("rare_envs/CutIn-v0", action=action)
    chosen = np.int64(3) if action == "meta" else np.array([0.5, 0.1], np.float32)
    single.reset(seed=1), standard.reset(seed=1)
    over = False
    while not over:
        _, earned, over, cut, info = single.step(chosen)
        assert batch.step(np.stack([chosen] * 3))[1][1] == earned
        if reward is WEIGHTS:  # which are those of the reward that nobody asked for
            assert earned == pytest.approx(standard.step(chosen)[1], abs=1e-5)
        elif action == "continuous":
            assert earned == pytest.approx(0.05 * info["speed"] - 10.0 * info["collision"], abs=1e-5)
        over = over or cut
    assert info["collision"]


def test_terms_have_the_names_of_highway_env_and_others_are_refused() -> None:
    given = {"collision_reward": -1.0, "right_lane_reward": 0.1, "high_speed_reward": 0.4}
    env = gym.make("rare_envs/HardBrake-v0", reward=given)
    env.reset(options={"speed": 25.0, "gap": 30.0, "peak": 6.0, "loss": 20.0})
    _, earned, *_, info = env.step(np.zeros(2))
    assert info["reward_terms"] == pytest.approx({"collision": 0.0, "right_lane": 0.0, "high_speed": 0.2}, abs=1e-3)
    assert earned == pytest.approx(0.2, abs=1e-3)
    for wrong, said in (
        ({"speeed": 1.0}, r"^Unknown term of the reward 'speeed' \(did you mean 'speed'\?\); expected one of '"),
        ({"speed": None}, "^Expected a finite number as the weight of 'speed' in the reward, got None"),
        (3, "^Expected reward as weights by term, a function or 'module:function', got 3"),
        (lambda step: step.sped, "AttributeError: .* 'sped'"),
        (lambda step: step.speed[:1], r"^Expected a finite reward of shape \(2,\), a number, .* got array\("),
    ):
        with pytest.raises(ValueError, match=said) as refused:
            gym.make_vec("rare_envs/HardBrake-v0", 4, reward=wrong)
        assert "\n" not in str(refused.value)
