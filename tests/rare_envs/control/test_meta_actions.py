"""`observation="kinematics"` and `action="meta"` against HighwayEnv itself in float64, and through our environments."""

from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers its ids)
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import rare_envs
from benchmarks.simulation.highway_env_scene import HighwayEnvScene
from rare_envs.control.actions import (
    FASTER,
    IDLE,
    LANE_LEFT,
    LANE_RIGHT,
    SLOWER,
    TARGET_SPEEDS,
    follow_meta_actions,
    initial_aim,
)
from rare_envs.make import set_up
from rare_envs.simulation.observation import observe_kinematics
from rare_envs.study import Question
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import State, bicycle
from tests.rare_envs.interop.egos import Always

Array = NDArray[np.float64]
SECONDS, TICKS = 5, 50
TOLERANCE = 1e-6


def state_of(traffic: Array) -> State:
    """x, y, heading and speed, shape (N, 4), as a batch of one."""
    x, y, heading, speed = torch.from_numpy(traffic)[None].unbind(dim=-1)
    return State(x, y, heading, speed, x[:, :0])


def random_traffic(rng: np.random.Generator, vehicles: int, lanes: int) -> Array:
    """Vehicles on straight courses near, beside, behind and out of sight of number 0, (T + 1, N, 4)."""
    start = np.stack(
        [
            rng.uniform(-60.0, 260.0, vehicles),
            rng.uniform(-1.0, 4.0 * lanes - 3.0, vehicles),
            rng.normal(0.0, 0.05, vehicles),
            rng.uniform(12.0, 36.0, vehicles),
        ],
        axis=1,
    )
    start[0, :2] = rng.uniform(0.0, 20.0), 4.0 * rng.integers(lanes) + rng.uniform(-1.9, 1.9)
    velocity = start[:, 3:] * np.stack([np.cos(start[:, 2]), np.sin(start[:, 2])], axis=1)
    tracks = np.repeat(start[None], TICKS + 1, axis=0)
    tracks[:, :, :2] += 0.1 * np.arange(TICKS + 1)[:, None, None] * velocity
    return tracks


def drive_by_hand(tracks: Array, lanes: int, decisions: list[int], ego: int) -> tuple[Array, Array]:
    """Motion of one vehicle (T + 1, 4) and its observations (6, 5, 5) by the functions alone."""
    road, state = straight(lanes), state_of(tracks[0])
    aim, motion, seen = initial_aim(state, road), [tracks[0, ego]], [observe_kinematics(state, road, ego)]
    obeys = torch.zeros_like(state.x, dtype=torch.bool)
    obeys[:, ego] = True
    for tick in range(TICKS):
        action = torch.full(state.x.shape, IDLE)
        action[:, ego] = IDLE if tick % 10 else decisions[tick // 10]
        aim, physical = follow_meta_actions(aim, action, obeys, state, road)
        own = [field[:, ego] for field in state[:4]]
        moved = bicycle(*own, physical[:, ego, 0], physical[:, ego, 1], 0.1)  # type: ignore[arg-type]
        traffic = tracks[tick + 1].copy()
        traffic[ego] = torch.cat(moved).numpy()
        state = state_of(traffic)
        motion.append(traffic[ego])
        if tick % 10 == 9:
            seen.append(observe_kinematics(state, road, ego))
    return np.array(motion), torch.cat(seen).numpy()


def test_observation_and_motion_are_highway_envs_in_random_scenes() -> None:
    rng = np.random.default_rng(0)
    lane_changes = rows_missing = 0
    for _ in range(7):
        lanes, vehicles = int(rng.integers(1, 5)), int(rng.integers(1, 9))
        tracks = random_traffic(rng, vehicles, lanes)
        decisions = rng.choice(5, SECONDS, p=[0.3, 0.1, 0.3, 0.15, 0.15]).tolist()
        ego = int(rng.integers(vehicles))
        scene = HighwayEnvScene(lanes, tracks, ego)
        theirs = np.array([scene.observe(), *(scene.step(action) for action in decisions)])
        motion, ours = drive_by_hand(tracks, lanes, decisions, ego)
        np.testing.assert_allclose(motion, scene.states, atol=TOLERANCE, rtol=0)
        np.testing.assert_allclose(ours, theirs, atol=TOLERANCE, rtol=0)
        lane_changes += abs(motion[-1, 1] - motion[0, 1]) > 2.5
        rows_missing += int((theirs[:, :, 0] == 0).sum())
    assert lane_changes >= 2
    assert rows_missing > 10


def test_lane_changes_need_a_lane_and_speeds_follow_the_present_speed() -> None:
    road = straight(2)

    def aimed(y: float, speed: float, *actions: int) -> tuple[int, float]:
        state = state_of(np.array([[0.0, y, 0.0, speed]]))
        aim = initial_aim(state, road)
        for action in actions:
            aim, _ = follow_meta_actions(aim, torch.tensor([action]), None, state, road)
        return int(aim.lane), TARGET_SPEEDS[int(aim.speed)]

    assert aimed(0.0, 24.0) == (0, 25.0)
    assert aimed(0.0, 24.0, LANE_LEFT) == (0, 25.0)
    assert aimed(0.0, 24.0, LANE_RIGHT) == (1, 25.0)
    assert aimed(0.0, 24.0, LANE_RIGHT, LANE_RIGHT, LANE_LEFT) == (0, 25.0)
    assert aimed(0.0, 24.0, FASTER, FASTER) == (0, 30.0)  # from 25, which is the nearest to 24, not from the target
    assert aimed(0.0, 31.0, SLOWER, IDLE) == (0, 25.0)
    assert aimed(0.0, 8.0, SLOWER) == (0, 20.0)
    assert aimed(0.0, 22.5) == (0, 20.0)  # half-way: NumPy rounds to the even index
    wide = straight(4)
    for y, lane in ((0.1, 2), (-0.1, 1)):  # the third lane is more than two widths away from y = -0.1
        state = state_of(np.array([[0.0, y, 0.0, 25.0]]))
        aim = initial_aim(state, wide)
        for _ in range(2):
            aim, _ = follow_meta_actions(aim, torch.tensor([LANE_RIGHT]), None, state, wide)
        assert int(aim.lane) == lane


def test_a_vehicle_that_begins_to_obey_aims_for_where_it_is() -> None:
    world, _ = set_up("rare_envs/CutIn-v0", action="meta")
    x = torch.tensor([[15.0, 24.0, 24.0, 40.0, 40.0, 4.0]], dtype=torch.float64)
    episode = world.start(x)
    idle, nobody = torch.full((1, 3), IDLE), torch.zeros(1, 3, dtype=torch.bool)
    for _ in range(35):  # the script brings the cutter into the ego's lane
        episode = episode._replace(aim=world.decode_meta_actions(episode, idle, nobody)[0].aim)
        episode = world.step(*world.decode_meta_actions(episode, torch.tensor([IDLE])))
    cutter = nobody.clone()
    cutter[0, 1] = True
    for _ in range(20):
        episode = world.step(*world.decode_meta_actions(episode, idle, cutter), cutter)
    assert episode.aim is not None
    assert episode.aim.lane[0].tolist() == [0, 0, 0]
    assert abs(float(episode.state.y[0, 1])) < 0.2


def test_a_collision_within_a_decision_ends_it_there() -> None:
    env = gym.make("rare_envs/CarFollowing-v0", action="meta", observation="kinematics").unwrapped
    env.reset(options={"x": [30.0, 10.0, 8.5]})  # contact after about 0.4 s
    observation, reward, terminated, _, info = env.step(IDLE)
    assert terminated
    assert info["measure"] == -1.0
    assert reward < -2.0  # a tenth of the -30 of a collision, and what the ticks before it earned
    gap = observation[1, 1] * 200.0 - 5.0
    assert -2.0 < gap <= 0.0  # the observation is of the moment of contact


def test_wrong_actions_are_refused() -> None:
    env = gym.make("rare_envs/CutIn-v0", action="meta").unwrapped
    env.reset(seed=0)
    for action in (5, -1, 1.0, np.zeros(2), True):
        with pytest.raises(ValueError, match=r"[Ee]xpected"):
            env.step(action)


class Recorder:
    """Stands for Gymnasium's `RecordVideo`: one frame after reset and after each step, and what it is asked for."""

    def __init__(self, env: Any) -> None:
        self.env, self.places, self.frames_per_sec = env, [], 1

    def _capture_frame(self) -> None:
        assert self.env.render().shape[2] == 3
        self.places.append(float(self.env._episode.state.x[0, 0]))


def test_a_recording_has_a_frame_of_every_tick() -> None:
    env: Any = gym.make("rare_envs/CarFollowing-v0", action="meta", render_mode="rgb_array").unwrapped
    recorder = Recorder(env)
    env.set_record_video_wrapper(recorder)
    env.reset(options={"x": [25.0, 25.0, 100.0]})
    for _ in range(2):
        env.step(IDLE)
        recorder._capture_frame()  # as the wrapper does after each step
    assert recorder.frames_per_sec == 10
    np.testing.assert_allclose(recorder.places, 2.5 * np.arange(1, 21), atol=1e-3)
    env.close()


def test_the_id_used_in_training_is_taken_everywhere() -> None:
    x = rare_envs.DrivingProblem("rare_envs/CutIn-v0").base.sample(4, np.random.default_rng(0))
    short = rare_envs.DrivingProblem("rare_envs/CutIn-kinematics-v0", ego=Always(IDLE))
    imported = rare_envs.DrivingProblem("rare_envs:rare_envs/CutIn-kinematics-v0", ego=Always(IDLE))
    whole = rare_envs.DrivingProblem("rare_envs/CutIn-v0", ego=Always(IDLE), observation="kinematics", action="meta")
    np.testing.assert_array_equal(short.evaluate(x), whole.evaluate(x))
    np.testing.assert_array_equal(imported.evaluate(x), whole.evaluate(x))
    assert short.env_id == imported.env_id == "rare_envs/CutIn-v0"
    many = rare_envs.parallel_env("rare_envs/CutIn-kinematics-v0")
    assert many.action_space("ego") == gym.spaces.Discrete(5)
    assert gym.make_vec("rare_envs/CutIn-kinematics-v0", num_envs=2).single_observation_space.shape == (5, 5)
    asked = Question(env_id="rare_envs/CutIn-kinematics-v0")
    assert asked == Question(env_id="rare_envs/CutIn-v0", observation="kinematics", action="meta")
