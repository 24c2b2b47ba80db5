"""Policies as drivers: what fits a world, what a policy is shown, its errors, and wrappers around it."""

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces

import rare_envs
from rare_envs.control.actions import IDLE
from rare_envs.egos.policy import PolicyQuery, as_driver, check_spaces, query_policy
from rare_envs.egos.wrappers import WrappedPolicy, find_frame_stacking
from rare_envs.plugins import EgoGone, NoAnswer, check_predict, refuse_ego
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.simulation.observation import observation_space
from rare_envs.simulation.settings import Clock
from rare_envs.simulation.world import World

WORLD = World(CAR_FOLLOWING)
X = torch.tensor([[20.0, 15.0, 30.0], [25.0, 15.0, 40.0], [30.0, 15.0, 50.0]])


class Recorder:
    """A policy that keeps what it is shown."""

    def __init__(self, **attributes: Any) -> None:
        self.shown: list[Any] = []
        self.__dict__.update(attributes)

    def predict(self, observation: Any, state: Any, episode_start: Any, deterministic: bool) -> Any:
        self.shown.append((observation.copy(), episode_start.copy()))
        return np.zeros((len(observation), 2)), state


def test_an_ego_for_another_tick_or_observation_is_refused() -> None:
    with pytest.raises(ValueError, match=r"Expected dt=0\.2 s"):
        as_driver(Recorder(dt=0.2), WORLD)
    with pytest.raises(ValueError, match="observation='lidar'"):
        as_driver(Recorder(observation_space=observation_space(2, "lidar")), WORLD)


def test_spaces_of_actions() -> None:
    expected = WORLD.observation_space
    check_spaces(Recorder(action_space=spaces.Box(-2, 2, (2,))), expected)
    check_spaces(Recorder(action_space=spaces.Discrete(5)), expected)
    check_spaces(Recorder(action_space=spaces.Discrete(5)), expected, "meta")
    check_spaces(Recorder(action_space=spaces.Discrete(5)), expected, "discrete")
    with pytest.raises(
        ValueError, match=r"takes Discrete\(5\) \(five accelerations\); take action='continuous' \(--action c"
    ):
        check_spaces(Recorder(action_space=spaces.Box(-1, 1, (2,))), expected, "discrete")
    for space, kind in ((spaces.Discrete(4), "continuous"), (spaces.MultiDiscrete([2, 2]), "continuous")):
        with pytest.raises(ValueError, match=r"the environment takes Box.* put an object with predict around it"):
            check_spaces(Recorder(action_space=space), expected, kind)
    with pytest.raises(ValueError, match=r"takes Discrete\(5\) \(LANE_LEFT.*SLOWER\); take action='continuous'"):
        check_spaces(Recorder(action_space=spaces.Box(-1, 1, (2,))), expected, "meta")


def test_a_policy_with_meta_actions_is_queried_once_a_second() -> None:
    class Meta(Recorder):
        def predict(self, *args: Any, **kwargs: Any) -> Any:
            super().predict(*args, **kwargs)
            return np.full(3, 3), None

    world = World(CAR_FOLLOWING, clock=Clock(horizon=2.0, action="meta"))
    policy, memory = Meta(), None
    driver = as_driver(policy, world)
    actions = []
    for _ in range(12):
        action, memory = driver.act(world.start(X), memory)
        actions.append(int(action[0]))
    assert actions == [3, *[IDLE] * 9, 3, IDLE]
    assert len(policy.shown) == 2


class Picky:
    """A policy that accelerates as it observes, and fails on negative observations."""

    def __init__(self, error: BaseException | None = None, memory: Any = None, times: int = 10**9) -> None:
        self.error, self.memory, self.times = error, memory, times
        self.sizes: list[int] = []

    def predict(self, observation: Any, state: Any, episode_start: Any, deterministic: bool) -> Any:
        assert deterministic
        self.sizes.append(len(observation))
        if self.error is not None and (observation < 0.0).any() and self.times:
            self.times -= 1
            raise self.error
        return np.concatenate((observation, 0.0 * observation), axis=1), self.memory


def query(values: list[float], hidden: Any = None, over: tuple[int, ...] = ()) -> PolicyQuery:
    n = len(values)
    rows = torch.tensor([row in over for row in range(n)])
    return PolicyQuery(np.array(values)[:, None], hidden, np.full(n, hidden is None), rows)


def test_failing_rows_get_a_reason_and_no_action() -> None:
    failed: dict[int, str] = {}
    policy = Picky(RuntimeError("no road"))
    action, _ = query_policy(policy, "continuous", query([0.2, -1.0, 0.4, 0.6]), failed)
    torch.testing.assert_close(action[:, 0], torch.tensor([1.0, 0.0, 2.0, 3.0]))
    assert failed == {1: "RuntimeError: no road"}
    assert policy.sizes == [4, 2, 1, 1, 2]


def test_actions_that_are_not_finite_cost_their_row_alone() -> None:
    failed: dict[int, str] = {}
    policy = Picky()
    action, _ = query_policy(policy, "continuous", query([np.nan, 0.4, np.nan], over=(2,)), failed)
    torch.testing.assert_close(action[:, 0], torch.tensor([0.0, 2.0, 0.0]))
    assert failed == {0: "NaN or infinite actions"}
    assert policy.sizes == [3]


def test_who_does_not_answer_is_queried_once_more() -> None:
    action, _ = query_policy(Picky(NoAnswer("lost"), times=1), "continuous", query([-0.2]))
    assert float(action[0, 0]) == pytest.approx(-1.0)
    with pytest.raises(NoAnswer):
        query_policy(Picky(NoAnswer("lost"), times=2), "continuous", query([-0.2]))


@pytest.mark.parametrize("hidden", [None, "kept"])
def test_a_batch_of_a_policy_with_a_memory_is_not_split(hidden: Any) -> None:
    failed: dict[int, str] = {}
    for error in (RuntimeError, EgoGone):  # one that is gone is gone
        with pytest.raises(error, match="no road"):
            query_policy(Picky(error("no road"), memory="kept"), "continuous", query([0.1, -1.0], hidden), failed)
    assert failed == {}


def test_a_failed_row_idles_where_actions_are_meta() -> None:
    class Meta:
        def predict(self, observation: Any, **_: Any) -> Any:
            if (observation < 0.0).any():
                raise RuntimeError("no road")
            return observation[:, 0].astype(int), None

    failed: dict[int, str] = {}
    action, _ = query_policy(Meta(), "meta", query([3.0, -1.0, 4.0]), failed)
    assert action.tolist() == [3, IDLE, 4]
    assert list(failed) == [1]


@pytest.mark.parametrize("answer", ["left", ["left", "left"], [None, None], [{"steering": 0.0}] * 2])
def test_actions_that_are_no_numbers_are_refused(answer: Any) -> None:
    class Wordy:
        def predict(self, observation: Any, **_: Any) -> Any:
            return answer, None

    with pytest.raises(ValueError, match="Expected actions as numbers, one or two for each observation, got"):
        query_policy(Wordy(), "continuous", query([0.1, 0.2]))


class Still:
    """A policy."""

    def predict(self, observation: Any, **_: Any) -> Any:
        return observation


class Proxy:
    """Passes all attributes of a policy on."""

    def __getattr__(self, name: str) -> Any:
        return getattr(Still(), name)


class Short:
    """As many write it; Stable-Baselines3 hands over more."""

    def predict(self, observation: Any) -> Any:
        return observation, None


def test_a_predict_of_the_observation_alone_is_refused_before_anything_is_simulated() -> None:
    for taken in (Still(), Proxy()):
        check_predict(taken)
    with pytest.raises(
        ValueError, match=r"state, episode_start, deterministic\), as .*, got predict\(observation.* of Short"
    ):
        rare_envs.DrivingProblem("rare_envs/CutIn-v0", ego=Short())
    with pytest.raises(ValueError, match=r"^Expected predict to return actions and memory \(.*\), got ndarray\.$"):
        query_policy(Still(), "continuous", query([-0.2]))


@pytest.mark.parametrize(
    ("ego", "origin", "message"),
    [
        ("imd", "", r"^Unknown ego 'imd'; expected 'idm' or an object\. .* agents\.load_ego\('imd'\)\.$"),
        ("imd", "from f()", r"^Unknown ego 'imd' from f\(\); "),
        (Still, "", r"^Expected an ego, got the class Still; make or train one"),
        (None, "", r"^Expected 'idm' or an object with a method predict\(observation, \.\.\.\), got NoneType\.$"),
    ],
)
def test_a_refusal_says_what_was_expected(ego: object, origin: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        refuse_ego(ego, origin)


SMALL = (36, 60)


def test_frames_of_spaces() -> None:
    image, row = spaces.Box(0, 255, (*SMALL, 3), np.uint8), spaces.Box(-5.0, 5.0, (51,))
    first = spaces.Box(0, 255, (6, *SMALL), np.uint8)
    assert find_frame_stacking(image, image) == (1, False)
    assert find_frame_stacking(image, first) == (2, False)
    assert find_frame_stacking(row, spaces.Box(-5.0, 5.0, (102,))) == (2, False)
    both = spaces.Dict({"camera": image, "lidar": row})
    assert find_frame_stacking(both, both) == (1, False)
    assert find_frame_stacking(both, spaces.Dict({"camera": first, "lidar": row})) is None  # not the same number
    assert find_frame_stacking(both, spaces.Dict({"camera": image})) is None
    assert find_frame_stacking(both, image) is None


class Echo:
    """A policy whose action is what it is shown."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return observation, state


def test_frames_side_by_side_begin_with_zeros_and_along_an_axis_with_copies() -> None:
    one, two = np.array([[1.0], [2.0]]), np.array([[3.0], [4.0]])
    for new_axis, first, second in (
        (False, [[0, 1], [0, 2]], [[1, 3], [0, 4]]),
        (True, [[[1], [1]], [[2], [2]]], [[[1], [3]], [[4], [4]]]),
    ):
        policy = WrappedPolicy(Echo(), frames=2, new_axis=new_axis)
        shown, state = policy.predict(one)
        np.testing.assert_array_equal(shown, first)
        shown, _ = policy.predict(two, state, episode_start=np.array([False, True]))  # the second row begins anew
        np.testing.assert_array_equal(shown, second)
