"""HighwayEnv's environments as scenarios: options, scenes, measures and distributions."""

from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers the ids)
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from highway_env.envs.highway_env import HighwayEnvFast
from highway_env.vehicle.behavior import IDMVehicle
from scipy import stats

from rare_envs import HighwayEnvScenario
from rare_envs.interop.problem import make_highway_env
from rare_envs.interop.scenario import HIGHWAY_ENV_MEASURES, install_fast_observation

SMALL = {"vehicles_count": 6, "duration": 5}
CONFIGS: dict[str, dict[str, Any] | None] = {
    "highway-v0": SMALL,
    "highway-fast-v0": SMALL,
    "merge-v1": None,
    "intersection-v2": {"initial_vehicle_count": 4, "duration": 4},
    "roundabout-v1": None,
}


def scenario(env_id: str, **kwargs: Any) -> Any:
    return HighwayEnvScenario(make_highway_env(env_id, CONFIGS[env_id]), **kwargs)


def others(env: Any) -> list[Any]:
    return [v for v in env.unwrapped.road.vehicles if v is not env.unwrapped.vehicle]


@pytest.mark.parametrize("env_id", ["highway-fast-v0", "merge-v1", "intersection-v2", "roundabout-v1"])
def test_same_x_same_scene_whatever_came_before(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env, again = scenario(env_id), scenario(env_id)
    _, info = env.reset(seed=7)
    monkeypatch.setattr(IDMVehicle, "DISTANCE_WANTED", 7.0)  # as HighwayEnv's own intersection leaves it
    again.reset(seed=3)
    first, second = env.reset(options={"x": info["x"]})[0], again.reset(options={"x": info["x"]})[0]
    np.testing.assert_array_equal(first, second)
    for _ in range(2):
        one, other = env.step(1), again.step(1)
        np.testing.assert_array_equal(one[0], other[0])
        assert one[4]["min_measure"] == other[4]["min_measure"]
    assert env.space.names == tuple(n for n in info["scenario"] if n not in env.fixed)


def test_wrong_environments_and_settings_are_refused() -> None:
    for env, message in (
        (gym.make("CartPole-v1"), "Expected an environment of HighwayEnv"),
        (gym.make("parking-v0"), "No parameters are known for ParkingEnv"),
        (gym.make("merge-generic-v1"), "No parameters are known"),
        (gym.wrappers.FlattenObservation(make_highway_env("highway-fast-v0", SMALL)), "put wrappers around this one"),
    ):
        with pytest.raises(ValueError, match=message):
            HighwayEnvScenario(env)
    for kwargs, message in (
        ({"vehicles": 7}, "vehicles from 1 to 6"),
        ({"measure": "tcc"}, "did you mean 'ttc'"),
        ({"fixed": {"gap": [5.0] * 4}}, "Unknown parameter to hold 'gap'"),
        ({"fixed": {"ego_sped": 5.0}}, "did you mean 'ego_speed'"),
        ({"fixed": {"ego_speed": 99.0}}, r"ego_speed = 99 .* \[0, 40\]"),
        ({"noise": False}, "noise True or 'fixed'"),
    ):
        with pytest.raises(ValueError, match=message):
            scenario("highway-fast-v0", **kwargs)
    with pytest.raises(ValueError, match="vehicles from 4 to 4"):
        scenario("merge-v1", vehicles=2)
    with pytest.raises(ValueError, match="did you mean 'highway-fast-v0'"):
        make_highway_env("highway-fst-v0", None)


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
@pytest.mark.filterwarnings("ignore:.*A Box observation space .*imum value is -?infinity")
def test_gymnasiums_checker_takes_it_and_makes_it_again() -> None:
    env = scenario("highway-fast-v0", vehicles=2)
    check_env(env, skip_render_check=True)
    assert gym.make(env.spec).space.names == env.space.names  # type: ignore[attr-defined]


def read_back(env: Any, env_id: str) -> dict[str, Any]:
    """The parameters of a scene that HighwayEnv made by itself."""
    ego, rest = env.unwrapped.vehicle, others(env)
    if env_id.startswith("roundabout"):
        lanes = [("we", "sx", 1), ("we", "sx", 0), ("we", "sx", 0), ("eer", "ees", 0)]
        found = [env.unwrapped.road.network.get_lane(index) for index in lanes]
        places = [lane.local_coordinates(v.position)[0] for lane, v in zip(found, rest, strict=True)]
        return {"speed": [v.speed for v in rest], "place": places}
    if env_id.startswith("merge"):
        ranked = [rest[1], rest[0], rest[2]]
        gaps = [abs(v.position[0] - ego.position[0]) - 5.0 for v in ranked]
        given: dict[str, Any] = dict(zip(("gap_ahead", "gap_second", "gap_behind"), gaps, strict=True))
    else:
        ranked = rest[:4]
        x = np.array([v.position[0] for v in (ego, *ranked)])
        given = {"ego_lane": ego.lane_index[2], "gap": np.diff(x) - 5.0}
    return {**given, "speed": [v.speed for v in ranked], "lane": [v.lane_index[2] for v in ranked]}


class Tailgater(IDMVehicle):
    TIME_WANTED, DISTANCE_WANTED = 0.3, 6.0


class Hasty(IDMVehicle):
    def randomize_behavior(self) -> None:
        self.target_speed = 35.0


class SlowTraffic(HighwayEnvFast):
    def _create_vehicles(self) -> None:
        super()._create_vehicles()
        self.road.vehicles[-1].speed = 0.0


class Lap(HighwayEnvFast):
    def _is_truncated(self) -> bool:
        return bool(self.time >= 2)


def test_a_class_of_the_users_is_taken_only_where_its_scene_is_the_known_one() -> None:
    def of(kind: type) -> Any:
        return make_highway_env("highway-fast-v0", {**SMALL, "other_vehicles_type": f"{__name__}.{kind.__name__}"})

    patched = make_highway_env("highway-fast-v0", SMALL)
    patched.unwrapped._create_vehicles = lambda: None  # type: ignore[attr-defined]
    for env, message in (
        (gym.make("exit-v1"), "scene by ConnectedLaneExitEnv._reset, which is not HighwayEnv's"),
        (SlowTraffic(SMALL), "SlowTraffic._create_vehicles, which is not HighwayEnvFast's"),
        (patched, "scene by HighwayEnvFast._create_vehicles"),
        (of(Hasty), "scene by Hasty.randomize_behavior"),
    ):
        with pytest.raises(ValueError, match=message):
            HighwayEnvScenario(env)
    assert HighwayEnvScenario(of(Tailgater), fixed="highway_env").fixed["time_headway"] == 0.3
    env = HighwayEnvScenario(Lap(SMALL))
    env.reset(seed=0)
    assert [env.step(1)[3] for _ in range(2)] == [False, True]


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
    """With vehicles that want gaps of their own in the merge."""
    config = {"other_vehicles_type": f"{__name__}.Tailgater"} if env_id == "merge-v1" else CONFIGS[env_id]
    plain, env = (make_highway_env(env_id, config) for _ in range(2))
    env = HighwayEnvScenario(env, fixed="highway_env")
    observation, _ = plain.reset(seed=3)
    given = read_back(plain, env_id)
    if "noise" in env.space.names:
        given["noise"] = np.uint64(3).view(np.float64)  # the number whose bits are this seed
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
    env, plain = scenario(env_id, fixed="highway_env"), make_highway_env(env_id, CONFIGS[env_id])
    x = env.space.sample(2000, np.random.default_rng(0))
    ours, theirs = env.space.columns(x), []
    for seed in range(40):
        plain.reset(seed=seed)
        theirs.append(read_back(plain, env_id))
    assert {*theirs[0], "noise"} == {*ours, "noise"}
    for name in theirs[0]:
        one = ours[name].reshape(len(x), -1)
        other = np.array([np.atleast_1d(given[name]) for given in theirs])
        one = np.floor(one) if "lane" in name else one
        assert min(stats.ks_2samp(a, b).pvalue for a, b in zip(one.T, other.T, strict=True)) > 1e-4, name
    u = env.space.to_standard_normal(x)
    np.testing.assert_allclose(env.space.from_standard_normal(u), x, atol=1e-8)


def test_idm_options_are_the_vehicles_own_and_those_of_vehicles_that_come_later() -> None:
    env = scenario("intersection-v2")
    idm = {"time_headway": 0.7, "jam_distance": 3.0, "max_acceleration": 4.0, "comfortable_deceleration": 2.0}
    env.unwrapped.config["spawn_probability"] = 1.0
    env.reset(seed=0, options=idm)
    env.step(1)
    for vehicle in others(env):
        assert (vehicle.TIME_WANTED, vehicle.DISTANCE_WANTED) == (0.7, 8.0)
        assert (vehicle.COMFORT_ACC_MAX, vehicle.COMFORT_ACC_MIN) == (4.0, -2.0)
    assert (IDMVehicle.TIME_WANTED, IDMVehicle.DISTANCE_WANTED, IDMVehicle.COMFORT_ACC_MIN) == (1.5, 10.0, -5.0)
    assert "TIME_WANTED" not in vars(env.unwrapped.vehicle)


def test_measures_by_hand() -> None:
    env = HighwayEnvScenario(make_highway_env("highway-fast-v0", {"vehicles_count": 2, "duration": 4}), vehicles=2)
    options = {"ego_lane": 0, "ego_speed": 30.0, "speed": [20.0, 10.0], "gap": [30.0, 2.0]}
    for lane, seconds in (([1, 0], 37.0 / 20.0), ([1, 1], 10.0)):  # the second one: 30 + 5 + 2 m ahead
        env.reset(options={**options, "lane": lane})
        for name in ("front_ttc", "ttc"):  # the other lane's is passed by
            assert HIGHWAY_ENV_MEASURES[name](env.scene) == pytest.approx(seconds)


SHUFFLED = ["presence", "x", "y", "vx", "vy", "heading", "cos_h", "sin_h", "long_off", "cos_d"]
KINDS: dict[str, tuple[str, dict[str, Any]]] = {
    "behind, unclipped": ("highway-fast-v0", {"see_behind": True, "clip": False, "vehicles_count": 3}),
    "shuffled, as it is": ("highway-fast-v0", {"order": "shuffled", "normalize": False, "features": SHUFFLED}),
    "merge, with its obstacle": ("merge-v1", {}),
    "intersection": ("intersection-v2", {}),
}


@pytest.mark.parametrize("kind", list(KINDS))
def test_observations_without_pandas_have_the_same_bits(kind: str) -> None:
    env_id, observation = KINDS[kind]
    config = {"observation": {"type": "Kinematics", **observation}} if observation else CONFIGS[env_id]
    slow, fast, blind = (make_highway_env(env_id, config) for _ in range(3))
    install_fast_observation(fast.unwrapped)
    install_fast_observation(blind.unwrapped, blind=True)
    expected = slow.reset(seed=3)[0]
    np.testing.assert_array_equal(expected, fast.reset(seed=3)[0])
    np.testing.assert_array_equal(0.0 * expected, blind.reset(seed=3)[0])
    for action in (1, 0, 2, 1):
        one, other = slow.step(action), fast.step(action)
        np.testing.assert_array_equal(one[0], other[0])
        assert one[0].dtype == other[0].dtype
        if one[2] or one[3]:
            break
