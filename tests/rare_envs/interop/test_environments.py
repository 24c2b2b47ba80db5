"""Layouts of HighwayEnv's environments: options are what the scene then has, and its own scenes can be put back."""

from typing import Any

import highway_env  # noqa: F401  (registers the ids)
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from rare_envs.interop.problem import make_highway_env
from tests.rare_envs.interop.scenes import CONFIGS, others, scenario


def read_back(env: Any, env_id: str) -> dict[str, Any]:
    """The parameters of a scene that HighwayEnv made by itself."""
    ego, rest = env.unwrapped.vehicle, others(env)
    if env_id.startswith("highway"):
        x = np.array([v.position[0] for v in (ego, *rest)])
        return {
            "ego_lane": ego.lane_index[2],
            "speed": [v.speed for v in rest[:4]],
            "gap": np.diff(x)[:4] - 5.0,
            "lane": [v.lane_index[2] for v in rest[:4]],
        }
    if env_id.startswith("merge"):
        second, first, behind, _ = rest
        gap = [abs(v.position[0] - ego.position[0]) - 5.0 for v in (first, second, behind)]
        ranked = (first, second, behind)
        return {
            **dict(zip(("gap_ahead", "gap_second", "gap_behind"), gap, strict=True)),
            "speed": [v.speed for v in ranked],
            "lane": [v.lane_index[2] for v in ranked],
        }
    lanes = [("we", "sx", 1), ("we", "sx", 0), ("we", "sx", 0), ("eer", "ees", 0)]
    network = env.unwrapped.road.network
    places = [network.get_lane(i).local_coordinates(v.position)[0] for i, v in zip(lanes, rest, strict=True)]
    return {"speed": [v.speed for v in rest], "place": places}


def draws(env_id: str, n: int) -> NDArray[np.float64]:
    plain, rows = make_highway_env(env_id, CONFIGS[env_id]), []
    for seed in range(n):
        plain.reset(seed=seed)
        given = read_back(plain, env_id)
        rows.append(np.concatenate([np.atleast_1d(given[name]) for name in given]))
    return np.array(rows)


def read_back_names(env_id: str) -> list[str]:
    if env_id.startswith("highway"):
        return ["ego_lane", "speed", "gap", "lane"]
    return ["gap_ahead", "gap_second", "gap_behind", "speed", "lane"] if "merge" in env_id else ["speed", "place"]


def test_highway_options_are_what_the_scene_then_has() -> None:
    env = scenario("highway-fast-v0", vehicles=3)
    lanes = [2, 0, 1]
    _, info = env.reset(
        seed=0,
        options={"ego_lane": 1, "ego_speed": 28.0, "speed": [10.0, 20.0, 30.0], "gap": [7.0, 50.0, 1.0], "lane": lanes},
    )
    ego, ahead = env.unwrapped.vehicle, others(env)
    assert (ego.speed, ego.lane_index[2], ego.position[1], ego.target_speed) == (28.0, 1, 4.0, 30.0)
    assert [v.speed for v in ahead[:3]] == [10.0, 20.0, 30.0] == [v.target_speed for v in ahead[:3]]
    assert [v.lane_index[2] for v in ahead[:3]] == lanes == [v.target_lane_index[2] for v in ahead[:3]]
    x = np.array([v.position[0] for v in (ego, *ahead)])
    np.testing.assert_allclose(np.diff(x)[:3] - 5.0, [7.0, 50.0, 1.0], atol=1e-9)
    assert (np.diff(x) > 5.0).all()  # those beyond are ahead of the last one
    assert info["scenario"]["gap"].tolist() == [7.0, 50.0, 1.0]
    np.testing.assert_array_equal(env.reset(options={"x": info["x"]})[1]["x"], info["x"])


def test_merge_options_are_what_the_scene_then_has() -> None:
    env = scenario("merge-v1")
    given = {"gap_ahead": 20.0, "gap_second": 60.0, "gap_behind": 4.0, "merging_gap": 50.0, "merging_speed": 18.0}
    env.reset(options={**given, "ego_speed": 26.0, "speed": [22.0, 23.0, 24.0], "lane": [0, 1, 1]})
    ego, (second, first, behind, merging) = env.unwrapped.vehicle, others(env)
    gaps = [abs(v.position[0] - ego.position[0]) - 5.0 for v in (first, second, behind, merging)]
    np.testing.assert_allclose(gaps, [20.0, 60.0, 4.0, 50.0], atol=1e-9)
    assert behind.position[0] < ego.position[0]
    assert [v.speed for v in (ego, first, second, behind, merging)] == [26.0, 22.0, 23.0, 24.0, 18.0]
    assert [v.lane_index[2] for v in (first, second, behind)] == [0, 1, 1]
    assert merging.lane_index == ("j", "k", 0)


def test_intersection_and_roundabout_options_are_what_the_scene_then_has() -> None:
    env = scenario("intersection-v2")
    env.reset(seed=1, options={"ego_gap": 40.0, "ego_speed": 6.0, "gap": 20.0, "speed": 9.0, "approach": 3})
    ego = env.unwrapped.vehicle
    challenger = env.unwrapped.road.vehicles[env.unwrapped.road.vehicles.index(ego) - 1]
    for vehicle, lane, gap, speed in ((ego, "o0", 40.0, 6.0), (challenger, "o3", 20.0, 9.0)):
        assert vehicle.lane_index[0] == lane
        assert vehicle.speed == speed
        assert vehicle.lane.length - vehicle.lane_offset[0] - 2.5 == pytest.approx(gap)
    assert challenger.route[-1][1] == "o1"  # straight on
    assert min(np.linalg.norm(v.position - ego.position) for v in others(env)) > 20.0

    env = scenario("roundabout-v1")
    env.reset(seed=1, options={"ego_gap": 8.0, "ego_speed": 5.0, "speed": [10.0, 11.0, 12.0, 13.0]})
    assert [v.speed for v in others(env)] == [10.0, 11.0, 12.0, 13.0]
    assert env.unwrapped.vehicle.lane.length - env.unwrapped.vehicle.lane_offset[0] - 2.5 == pytest.approx(8.0)


@pytest.mark.parametrize("env_id", ["highway-fast-v0", "merge-v1", "roundabout-v1"])
def test_a_scene_of_highway_env_put_back_by_its_parameters_drives_the_same(env_id: str) -> None:
    plain, env = make_highway_env(env_id, CONFIGS[env_id]), scenario(env_id, fixed="highway_env")
    for seed in (3, 4):
        observation, _ = plain.reset(seed=seed)
        given = read_back(plain, env_id)
        if "noise" in env.space.names:
            given["noise"] = np.uint64(seed).view(np.float64)  # the number whose bits are this seed
        again, _ = env.reset(options=given)
        assert set(env.space.names) == set(given)
        np.testing.assert_allclose(again, observation, atol=1e-6)
        for action in (1, 3, 2, 0):
            observation, reward, terminated, truncated, _ = plain.step(action)
            again, reward_again, *ended, _ = env.step(action)
            np.testing.assert_allclose(again, observation, atol=1e-6)
            assert reward_again == pytest.approx(reward, abs=1e-6)
            assert ended == [terminated, truncated]
            if terminated or truncated:
                break


@pytest.mark.parametrize("env_id", ["highway-fast-v0", "merge-v1", "roundabout-v1"])
def test_the_base_distribution_is_the_one_from_which_highway_env_draws(env_id: str) -> None:
    env = scenario(env_id, fixed="highway_env")
    theirs = draws(env_id, 40)
    x = env.space.sample(2000, np.random.default_rng(0))
    columns = env.space.columns(x)
    ours = np.hstack([columns[name].reshape(len(x), -1) for name in env.space.names if name != "noise"])
    whole = {"ego_lane", "lane"}
    names = [n for n in env.space.names if n != "noise"]
    sizes = dict(zip(env.space.names, env.space.sizes, strict=True))
    discrete = np.repeat([n in whole for n in names], [sizes[n] for n in names])
    order = {n: k for k, n in enumerate(read_back_names(env_id))}
    theirs = np.hstack([np.split(theirs, np.cumsum([sizes[n] for n in order])[:-1], axis=1)[order[n]] for n in names])
    p = [
        stats.ks_2samp(np.floor(ours[:, j]) if discrete[j] else ours[:, j], theirs[:, j]).pvalue
        for j in range(ours.shape[1])
    ]
    assert min(p) > 1e-4
    u = env.space.to_standard_normal(x)
    np.testing.assert_allclose(env.space.from_standard_normal(u), x, atol=1e-8)
