"""Measures of whole episodes: traces, post-encroachment time, formulas, combinations, and one value everywhere."""

import math
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import Tensor

import rare_envs
from rare_envs.control.idm import IDM
from rare_envs.measures import Measure, Moment, Trace, TraceMeasure, minimum, stl, ttc, weighted, with_collision
from rare_envs.measures.two_dimensional import PET_MAX, pet
from rare_envs.scenarios.registry import find_scenario
from rare_envs.simulation.settings import Measurement
from rare_envs.simulation.world import World, drive, rollout
from rare_envs.study.replay import drive_again
from rare_envs.traffic.bodies import lead_of
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import State
from samplers.evaluate import Evaluator
from tests.rare_envs.measures.moments import AWAY, CLOSE, CUT_IN, F64, FOLLOWING, HIT, f, problem
from tests.rare_envs.traffic.slow_boxes import corners


@pytest.mark.parametrize(
    ("name", "collision"),
    [
        *((name, -1.0) for name in ("ttc", "mttc", "pet", "clearance", "thw", "ttc_2d")),
        *((name, -100.0) for name in ("drac", "btn", "required_deceleration")),
        *(("ttb", -10.0), ("rss_margin", -1000.0)),
    ],
)
def test_a_collision_is_worse_than_anything_else(name: str, collision: float) -> None:
    values = problem(name).evaluate(np.array([HIT, CLOSE, AWAY]))
    assert values[0] == collision
    assert values[1] < values[2]
    assert values[0] < values[1]


def test_rapid_manoeuvres_count_collisions_apart() -> None:
    """IDM brakes by 5 m/s^2 at most, which is more than 0.5 g; with a hit it is too late."""
    around = rare_envs.DrivingProblem(FOLLOWING, measure="evasive_manoeuvre")
    f = around.evaluate(np.array([(30.0, 10.0, 5.0), (30.0, 10.0, 60.0), (20.0, 20.0, 100.0)]))
    assert f[0] == -100.0
    assert f[1] == pytest.approx(1.0 - 5.0 / (0.5 * 9.80665), abs=1e-4)
    assert 0.99 < f[2] < 1.0


class Braking:
    """An ego that brakes from the first moment on."""

    def __init__(self, deceleration: float) -> None:
        self.deceleration = deceleration

    def act(self, episode, memory):
        return torch.tensor([-self.deceleration, 0.0]).expand(len(episode.collided), 2), memory


def test_a_near_crash_is_what_half_a_g_does_not_avoid() -> None:
    """From 20 m/s behind 10 m/s: v^2 / (2 b) = 6.25 m at 8 m/s^2, 10.2 m at 0.5 g, half a tick's way more at most."""
    half_g = 0.5 * 9.80665
    gaps = {"contact": 6.2, "near": 8.5, "safe": 10.8}
    assert 100 / 16.0 + 0.5 < gaps["near"] < 100 / (2 * half_g) < gaps["safe"] - 0.5
    x = np.array([(20.0, 10.0, gap) for gap in gaps.values()])
    f = rare_envs.DrivingProblem(FOLLOWING, Braking(8.0), "near_crash").evaluate(x)
    assert f[:2].tolist() == [-100.0, -1.0]
    gentle = rare_envs.DrivingProblem(FOLLOWING, Braking(half_g), "ttc").evaluate(x)
    assert gentle[:2].tolist() == [-1.0, -1.0]
    assert f[2] == gentle[2] > 0.0
    own = rare_envs.DrivingProblem(FOLLOWING, Braking(4.0), "near_crash").evaluate(x)
    assert own[2] == -100.0  # nothing rapid about it, and too late


def test_near_crashes_are_those_of_a_second_rollout_with_the_same_noise() -> None:
    around = rare_envs.DrivingProblem("rare_envs/HardBrake-v0", "human", "near_crash")
    x = around.base.sample(1500, np.random.default_rng(5))
    f = around.evaluate(x)
    rows = torch.from_numpy(x).float()
    with torch.inference_mode():
        for rapid in (True, False):
            world = replace(around.world, rapid=rapid, measurement=Measurement("ttc"))
            ttc_of = rollout(world, around.driver, rows).f.double().numpy()
            if rapid:
                own = ttc_of
    letter = rare_envs.DrivingProblem("rare_envs/HardBrake-v0", "human", "evasive_manoeuvre").evaluate(x)
    contact, rapid = letter == -100.0, letter <= 0.0
    np.testing.assert_array_equal(f[contact], -100.0)
    np.testing.assert_array_equal(f[~rapid], own[~rapid])
    np.testing.assert_array_equal(f[rapid & ~contact], ttc_of[rapid & ~contact])
    assert (rapid & ~contact).sum() > 50 < (~rapid).sum()
    np.testing.assert_array_equal(around.terms(x[:50]).f, f[:50])
    worst = int(f[rapid & ~contact].argmin())
    assert drive_again(around, x[rapid & ~contact][worst]).f == f[rapid & ~contact][worst]


def test_whoever_has_to_evade_the_ego_makes_a_near_crash() -> None:
    """A scenario that says so where its lead is slower than 12 m/s; the ego keeps away from it by itself."""
    scenario = replace(find_scenario(FOLLOWING), name="evading", evades=lambda state: state.speed[:, 1] < 12.0)
    world = World(scenario, measurement=Measurement("near_crash"))
    x = torch.tensor([(20.0, 10.0, 100.0), (20.0, 15.0, 100.0), (30.0, 5.0, 5.0)])
    f = rollout(world, IDM(), x).f
    assert f[:1].tolist() + f[2:].tolist() == [0.0, -100.0]
    assert f[1] > 0.0


def test_a_measure_of_two_rollouts_is_not_combined() -> None:
    with pytest.raises(ValueError, match="two rollouts"):
        minimum("ttc", "near_crash")


class FailsInTheSecond:
    """A policy that brakes by 5 m/s^2, and fails at a speed of row 1 that half a tick of braking by 0.5 g leads to."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        speed = 30.0 * observation[:, 0]
        if ((speed > 20.0 - 5 * 0.4904) & (speed < 20.0 - 5 * 0.4902)).any():
            raise RuntimeError("no idea")
        return np.repeat(np.float32([[-1.0, 0.0]]), len(observation), axis=0), state


def test_failures_of_a_policy_in_second_rollouts_are_those_of_their_rows() -> None:
    around = rare_envs.DrivingProblem(FOLLOWING, FailsInTheSecond(), "near_crash", horizon=1.0)
    x = np.array([(45.0, 0.0, 1.0), (21.0, 19.0, 100.0), (20.0, 19.0, 100.0), (22.0, 19.0, 100.0)])
    tolerant = Evaluator(around, on_error="failure")
    f = tolerant.evaluate(x)
    assert ["no idea" in fault.reason for fault in tolerant.faults] == [True]
    assert np.isnan(f).tolist() == [False, False, True, False]


def test_margin_goes_on_past_contact() -> None:
    hits = problem("margin").evaluate(np.array([[20.0, 15.0, 20.2], [20.0, 10.0, 60.5], [30.0, 10.0, 60.5]]))
    assert hits == pytest.approx([-5.0, -10.0, -20.0])
    near = problem("margin").evaluate(np.array([[20.0, 10.0, 100.2], [20.0, 10.0, 101.0]]))
    assert 0.0 < near[0] < near[1] < 0.2


RTAMT = "rtamt runs on Python 3.11 or older"
needs_rtamt = pytest.mark.skipif(find_spec("rtamt") is None, reason=RTAMT)
SAMPLE: dict[str, Callable[[], object]] = {
    **{name: (lambda name=name: name) for name in ("drac", "tet", "pet", "margin", "near_crash")},
    "minimum": lambda: minimum("ttc", "pet", with_collision("drac", -3.0)),
    "stl": lambda: stl("always (gap > 2 or ttc > 1)"),
    "function": lambda: lambda moment: moment.lead.gap.clamp(max=99.0),
}


@pytest.mark.parametrize("name", SAMPLE)
def test_same_value_alone_in_a_batch_and_in_a_problem(name: str) -> None:
    if name == "stl":
        pytest.importorskip("rtamt", reason=RTAMT)
    measure, kwargs = SAMPLE[name](), {"horizon": 2.0}
    whole = problem(measure, CUT_IN, **kwargs)
    # half of them collide, at different times
    x = whole.base.sample(6, np.random.default_rng(2))
    x[:3, 3], x[:3, 0], x[:3, 1] = (2.0, 6.0, 12.0), 32.0, 15.0
    expected = whole.evaluate(x)
    batch = gym.make_vec(CUT_IN, 6, vectorization_mode="vector_entry_point", measure=measure, **kwargs)
    batch.reset(seed=1, options={"x": x})
    ends: list[tuple[np.ndarray, float]] = []
    for _ in range(45):  # on through the episodes that follow
        *_, infos = batch.step(np.zeros((6, 2), dtype=np.float32))
        for row in np.flatnonzero(infos.get("_final_info", [])):
            ends.append((infos["final_info"]["x"][row], infos["final_info"]["measure"][row]))
    assert len(ends) >= 12
    found = whole.evaluate(np.array([end[0] for end in ends]))
    np.testing.assert_array_equal([end[1] for end in ends], found)
    env = gym.make(CUT_IN, measure=measure, **kwargs)
    for point, value in zip(x[1:4], expected[1:4], strict=True):
        env.reset(options={"x": point})
        while True:
            *_, terminated, truncated, info = env.step(np.zeros(2, dtype=np.float32))
            if terminated or truncated:
                break
        assert info["measure"] == value


def test_functions_of_a_moment_and_of_an_episode() -> None:
    def gap(moment: Moment) -> Tensor:
        return moment.lead.gap

    def mean_speed(trace: Trace) -> Tensor:
        speed, valid = trace.state.speed[:, :, 0], trace.valid
        return (speed * valid).sum(0) / valid.sum(0)

    assert f(gap, *CLOSE) == pytest.approx(0.5, abs=1e-4)
    assert f(gap, *HIT) == -1.0
    assert f(Measure(gap, collision=None), *HIT) == pytest.approx(0.5, abs=1e-4)  # the last moment before
    assert f(TraceMeasure(mean_speed), *CLOSE) == pytest.approx(20.0)
    assert f(TraceMeasure(mean_speed, critical=30.0), *CLOSE) == pytest.approx(10.0)
    assert f(TraceMeasure(mean_speed), *HIT) == -1.0


def test_a_trace_has_the_moments_of_the_drive() -> None:
    seen: list[Trace] = []

    def keep(trace: Trace) -> Tensor:
        seen.append(trace)
        return trace.of(ttc).amin(0)

    world = problem(TraceMeasure(keep, collision=None)).world
    x = torch.tensor([HIT, CLOSE])
    episodes = list(drive(world, problem("ttc").driver, x))
    values = episodes[-1].f
    last = seen[-1]
    assert last.state.x.shape == (101, 2, 2)
    assert last.valid.sum(0).tolist() == [62, 101]  # contact at 6.05 s
    assert last.collided.tolist() == [True, False]
    for k, episode in enumerate(episodes):
        torch.testing.assert_close(last.state.x[k, 1], episode.state.x[1], rtol=0, atol=0)
        torch.testing.assert_close(last.of(ttc)[k, 1], ttc(Moment(*episode[:2], episode.road, None))[1], rtol=0, atol=0)
    assert (last.state.x[62:, 0] == last.state.x[61, 0]).all()  # what came after the collision is not shown
    assert values[1] == pytest.approx(f("ttc", *CLOSE))


def trace(*paths: tuple[np.ndarray, np.ndarray, np.ndarray], dt: float = 0.1) -> Trace:
    """One episode on a wide road: x, y and heading over time of each vehicle, the ego first."""
    x, y, heading = (torch.from_numpy(np.stack(each, axis=1)[:, None]) for each in zip(*paths, strict=True))
    state = State(x, y, heading, torch.zeros_like(x), torch.zeros(len(x), 1, 0, dtype=F64))
    lead = lead_of(State(*(each[:, 0] for each in state)), straight(9))
    valid = torch.ones(len(x), 1, dtype=torch.bool)
    shaped = lead._replace(gap=lead.gap[:, None], closing_speed=lead.closing_speed[:, None])
    return Trace(state, shaped, straight(9), None, valid, torch.zeros(1, dtype=torch.bool), dt)


def line(x: float, y: float, heading: float, speed: float, dt: float = 0.1) -> tuple[np.ndarray, ...]:
    time = np.arange(round(4.0 / dt) + 1) * dt
    return x + speed * math.cos(heading) * time, y + speed * math.sin(heading) * time, np.full_like(time, heading)


def inside(points: np.ndarray, x: np.ndarray, y: np.ndarray, heading: np.ndarray) -> np.ndarray:
    dx, dy = points[..., 0] - x, points[..., 1] - y
    along, across = dx * np.cos(heading) + dy * np.sin(heading), dy * np.cos(heading) - dx * np.sin(heading)
    return (np.abs(along) < 2.5) & (np.abs(across) < 1.0)


def outline(x: float, y: float, heading: float) -> np.ndarray:
    a = corners(x, y, heading)
    share = np.linspace(0.0, 1.0, 15)[:, None]
    return np.concatenate([p + share * (q - p) for p, q in zip(a, np.roll(a, -1, axis=0), strict=True)])


def test_post_encroachment_time_by_hand() -> None:
    # in the lead's place gap / speed later, whatever the lead's speed
    assert pet(trace(line(0.0, 0.0, 0.0, 20.0), line(17.3, 0.0, 0.0, 20.0))).item() == pytest.approx(12.3 / 20.0)
    # the same with the ego in front, and another vehicle far away
    behind, far = line(-17.3, 0.0, 0.0, 20.0), line(0.0, 100.0, 0.0, 20.0)
    assert pet(trace(line(0.0, 0.0, 0.0, 20.0), behind, far)).item() == pytest.approx(12.3 / 20.0)
    assert pet(trace(line(0.0, 0.0, 0.0, 20.0), far)).item() == PET_MAX
    # at right angles: the other has left the ego's lane after (1 + 2.5) m / 10 m/s, the ego's front reaches it after
    # (20 - 1 - 2.5) m / 10 m/s
    across = line(20.0, 0.0, math.pi / 2, 10.0)
    assert pet(trace(line(0.0, 0.0, 0.0, 10.0), across)).item() == pytest.approx(1.65 - 0.35, abs=1e-4)
    assert pet(trace(across, line(0.0, 0.0, 0.0, 10.0))).item() == pytest.approx(1.65 - 0.35, abs=1e-4)


def test_post_encroachment_time_is_the_least_delay_with_an_overlap() -> None:
    """Against every pair of moments on a grid of 0.02 s, and points on the bodies' outlines."""
    rng = np.random.default_rng(4)
    for _ in range(8):
        speeds, angle = rng.uniform(6.0, 12.0, 2), rng.uniform(0.3, 2.8)
        start = (20.0 + rng.uniform(-8, 8), -15.0 * math.sin(angle) + rng.uniform(-3, 3))
        fast = [line(0.0, 0.0, 0.0, speeds[0], 0.02), line(*start, angle, speeds[1], 0.02)]
        bodies = [np.stack([outline(*pose) for pose in zip(*each, strict=True)]) for each in fast]
        touch = np.zeros((len(fast[0][0]),) * 2, dtype=bool)
        for k in range(len(touch)):
            touch[k] = inside(bodies[1], *(each[k] for each in fast[0])).any(1)
            touch[:, k] |= inside(bodies[0], *(each[k] for each in fast[1])).any(1)
        ego, other = np.nonzero(touch)
        slow = np.abs(ego - other).min() * 0.02 if len(ego) else PET_MAX
        found = pet(trace(line(0.0, 0.0, 0.0, speeds[0]), line(*start, angle, speeds[1]))).item()
        if slow > 0.02:
            assert found == pytest.approx(slow, abs=0.04)


def test_combinations() -> None:
    x = np.array([HIT, CLOSE, AWAY, (15.0, 14.0, 13.0)])
    of = {name: problem(name).evaluate(x) for name in ("ttc", "drac", "thw", "tet", "pet")}
    both = problem(minimum("ttc", "drac", "pet")).evaluate(x)
    np.testing.assert_array_equal(both, np.min([of["ttc"], of["drac"], of["pet"]], axis=0))
    added = problem(weighted(("ttc", 0.5), ("thw", 2.0), ("tet", 1.0))).evaluate(x)
    np.testing.assert_allclose(added, 0.5 * of["ttc"] + 2.0 * of["thw"] + of["tet"], rtol=1e-6)
    on_top = problem(with_collision(weighted(("thw", 2.0)))).evaluate(x)
    np.testing.assert_allclose(on_top, [-1.0, *(2.0 * of["thw"][1:])], rtol=1e-6)
    nested = problem(minimum(weighted(("ttc", 1.0)), with_collision("drac", -7.0))).evaluate(x)
    assert nested[0] == -7.0


@needs_rtamt
def test_robustness_by_hand() -> None:
    assert f(stl("always (gap > 2)"), *CLOSE) == pytest.approx(-1.5, abs=1e-3)
    assert f(stl("always[0:5] (gap > 2)"), *CLOSE) == pytest.approx(48.5, abs=1e-3)  # 50.5 m at 5 s
    assert f(stl("eventually[2:3] (ttc < 7.5)"), *CLOSE) == pytest.approx(7.5 - 7.05, abs=1e-3)
    assert f(stl("always (speed_1 > 3 and x_0 < 150)"), *CLOSE) == pytest.approx(-50.0, abs=1e-3)
    assert f(stl("(gap > 20) until (speed > 19)"), *CLOSE) == pytest.approx(1.0)
    assert f(stl("always ((ttc < 3) implies (acceleration < -1))"), *CLOSE) == pytest.approx(-1.0, abs=1e-3)
    assert f(stl("always (gap > 2)"), *HIT) < -1.5  # the moment of the collision is part of it
    assert f(with_collision(stl("always (speed > 0)"), -5.0), *HIT) == -5.0


@needs_rtamt
@pytest.mark.parametrize(
    ("formula", "words"),
    [
        ("always (gap >", ["does not parse"]),
        ("always (gpa > 2)", ["'gpa'", "did you mean 'gap'", "ttc"]),
        ("always (gap > 2) always (gap > 3)", ["one formula"]),
        ("", ["does not parse"]),
        (3, ["Expected a formula"]),
    ],
)
def test_bad_formulas_are_refused_before_anything_is_driven(formula: str, words: list[str]) -> None:
    with pytest.raises(ValueError) as error:
        stl(formula)
    assert all(word in str(error.value) for word in words)


@needs_rtamt
def test_formulas_that_do_not_fit_the_world_are_refused() -> None:
    with pytest.raises(ValueError, match="vehicles are 0 to 1"):
        problem(stl("always (speed_2 > 1)"))
    with pytest.raises(ValueError, match="multiple of the sampling period"):
        problem(stl("always[0:0.05] (gap > 1)"))
