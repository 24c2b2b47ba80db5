"""An ego behind the imperfections of a stack: each does what it says, and their randomness is all in x."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch

import rare_envs
import samplers
from agents import load_ego
from agents.imperfect_stack import ERRORS_PER_VEHICLE, OWN_ERRORS, NoisyEgo, Stack
from rare_envs.simulation.world import drive, rollout

ENV = "rare_envs/CutIn-v0"
PERFECT = Stack(**dict.fromkeys(Stack.__dataclass_fields__, 0.0) | {"jerk": 1e6, "steering_rate": 1e6})


def problem(ego: Any, noise: Any = True, horizon: float = 4.0) -> rare_envs.DrivingProblem:
    return rare_envs.DrivingProblem(ENV, ego=ego, noise=noise, horizon=horizon, base="us101-15-offsets")


def test_a_perfect_stack_changes_nothing() -> None:
    for noise in (True, "fixed", False):
        around, plain = problem(NoisyEgo("idm", PERFECT), noise), problem("idm")
        x = around.base.sample(50, np.random.default_rng(0))
        np.testing.assert_allclose(around.evaluate(x), plain.evaluate(x[:, :6]), atol=1e-4)


def test_the_probability_is_that_of_fresh_noise() -> None:
    """Once with the noise as columns of x, once drawn by a generator of its own in each rollout; by another method."""
    ego, gamma, n = load_ego("noisy:idm"), 1.5, 4000
    around = problem(ego)
    by_columns = samplers.estimate(around, samplers.MonteCarlo(), gamma=gamma, seed=0, max_sim=n)
    bare = problem("idm")
    x = torch.from_numpy(bare.base.sample(n, np.random.default_rng(5))).float()
    fresh = torch.randn(n, around.driver.noise_columns, generator=torch.Generator().manual_seed(5))
    with torch.inference_mode():
        f = rollout(around.world, around.driver, torch.cat((x, fresh), dim=1)).f
    p = float((f <= gamma).float().mean())
    error = math.sqrt(2 * p * (1 - p) / n)
    assert 0.005 < p < 0.2
    assert abs(by_columns.p - p) < 4 * error
    assert p > 1.5 * float((bare.evaluate(x.double().numpy()) <= gamma).mean())  # the noise matters
    two_stage = samplers.estimate(around, samplers.AdaptiveSubsetSimulation(n=800), gamma=gamma, seed=1)
    assert abs(math.log(two_stage.p / p)) < 4 * math.hypot(error / p, two_stage.cov)


def test_everything_random_is_in_x() -> None:
    around = problem(load_ego("noisy:idm"))
    x = around.base.sample(40, np.random.default_rng(1))
    f = around.evaluate(x)
    np.testing.assert_array_equal(around.evaluate(x), f)
    np.testing.assert_allclose(around.evaluate(x[7:9]), f[7:9], atol=1e-5)
    other = x.copy()
    other[:, 6:] = around.base.sample(40, np.random.default_rng(2))[:, 6:]
    assert (around.evaluate(other) != f).any()
    plans, size = around.driver.stack.noise_shape(around.world)
    assert (plans, size) == (20, OWN_ERRORS + ERRORS_PER_VEHICLE * 2)
    assert around.space.names[-1] == "ego_noise"
    assert around.dim == 6 + plans * size == len(around.space.low)


def test_errors_have_the_declared_distribution() -> None:
    stack = Stack(missed=0.05, correlation=0.4)
    driver = problem(NoisyEgo("idm", stack)).driver
    n = 20_000
    draws = torch.randn(n, driver.noise_columns, generator=torch.Generator().manual_seed(0))
    driver = driver.with_draws(draws)
    errors = [driver._step_errors(torch.zeros(n, driver.stack.noise_shape(driver.world)[1]), 0)]
    for plan in range(1, 4):
        errors.append(driver._step_errors(errors[-1], plan))
    for late, each in enumerate(errors):
        np.testing.assert_allclose(each.std(dim=0), 1.0, atol=0.03)
        kept = (each * errors[0]).mean(dim=0)
        np.testing.assert_allclose(kept, math.exp(-late * 0.2 / 0.4), atol=0.04)
    state = driver.world.start(torch.from_numpy(problem("idm").base.sample(n, np.random.default_rng(0))).float()).state
    seen = driver._perceive(state, state, errors[-1])
    missed = seen.x[:, 1:] - seen.x[:, :1] > 300.0
    np.testing.assert_allclose(missed.float().mean(dim=0), 0.05, atol=5 * math.sqrt(0.05 / n))
    np.testing.assert_allclose((seen.y[:, 0] - state.y[:, 0]).std(), stack.across, rtol=0.03)
    off = (seen.x - state.x)[:, 1:][~missed]
    np.testing.assert_allclose(off.std(), stack.position, rtol=0.03)
    np.testing.assert_allclose((seen.speed - state.speed)[:, 1:].std(), stack.speed, rtol=0.05)


class Recorder:
    """Notes what it sees, and asks for one action."""

    def __init__(self) -> None:
        self.seen: list[Any] = []

    def act(self, episode: Any, memory: Any) -> Any:
        self.seen.append(episode.state)
        wanted = torch.tensor([2.0, 0.01]).expand(len(episode.collided), 2)
        return wanted * len(self.seen), memory


def test_others_are_seen_late_and_the_speed_is_planned_now_and_then() -> None:
    recorder = Recorder()
    around = problem(NoisyEgo(recorder, replace(PERFECT, latency=0.3, period=0.2)))
    x = torch.from_numpy(around.base.sample(3, np.random.default_rng(0))).float()
    true = [episode.state for episode in drive(around.world, around.driver, x)]
    for tick, seen in enumerate(recorder.seen):
        late = true[max(tick - 3, 0)]
        torch.testing.assert_close(seen.x[:, 1:] - seen.x[:, :1], late.x[:, 1:] - late.x[:, :1], atol=1e-3, rtol=0)
        torch.testing.assert_close(seen.speed[:, 1:], late.speed[:, 1:])
        torch.testing.assert_close(seen.y[:, 0], true[tick].y[:, 0])
    speed = torch.stack([state.speed[:, 0] for state in true])
    gained = speed[1:] - speed[:-1]
    planned = 0.1 * torch.tensor([2.0 * (1 + 2 * (tick // 2)) for tick in range(len(gained))])
    torch.testing.assert_close(gained[:6], planned[:6, None].expand(6, 3), atol=1e-3, rtol=0)


def test_actuators_follow_with_a_lag_and_within_their_rates() -> None:
    driver = problem(NoisyEgo("idm", Stack(lag=0.5, steering_lag=0.2, jerk=1e6, steering_rate=1e6))).driver
    done, wanted = torch.zeros(1, 2), torch.tensor([[-4.0, 0.05]])
    for tick in range(1, 30):
        done = driver._actuate(done, wanted)
        expected = [-4.0 * (1 - math.exp(-tick * 0.1 / 0.5)), 0.05 * (1 - math.exp(-tick * 0.1 / 0.2))]
        np.testing.assert_allclose(done[0], expected, rtol=1e-4)
    slow = problem(NoisyEgo("idm", Stack(lag=0.0, steering_lag=0.0, jerk=10.0, steering_rate=0.2))).driver
    np.testing.assert_allclose(slow._actuate(torch.zeros(1, 2), wanted)[0], [-1.0, 0.02], rtol=1e-5)


class Absent:
    """Follows the lead, but for 5 % of the drives, which it decides by itself at their start: then it coasts."""

    deterministic = False

    def __init__(self) -> None:
        self.rng = np.random.default_rng(7)
        self.asked: list[float] = []

    def predict(self, observation: Any, state: Any, episode_start: Any, deterministic: bool) -> Any:
        if state is None:
            state = self.rng.uniform(size=len(observation)) < 0.05
            self.asked += observation[:, 3].tolist()
        speed, gap, closing = observation[:, 0], observation[:, 3], observation[:, 4]
        wanted = np.where(state, 0.0, 5.0 * (gap - 0.9 * speed) + 20.0 * closing)
        return np.stack((wanted, 0.0 * wanted), axis=1).clip(-1.0, 1.0).astype(np.float32), state


def test_outcomes_of_an_ego_with_noise_of_its_own_stand_as_they_fell() -> None:
    """p over its noise too is that of Monte Carlo; each scenario is simulated once, and its outcome never again."""
    ego, gamma = Absent(), 1.5
    world = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=ego, horizon=4.0, base="us101-gap")
    assert world.varies
    plain = samplers.estimate(world, samplers.MonteCarlo(), gamma=gamma, max_sim=12_000, seed=1)
    assert len(ego.asked) == plain.n_sim
    ego.asked.clear()
    found = samplers.estimate(world, samplers.TwoStage(), gamma=gamma, max_sim=5000, seed=2)
    assert len(ego.asked) == found.n_sim
    assert len(set(ego.asked)) > 0.99 * found.n_sim  # but for rounding to single precision
    assert abs(math.log(found.p / plain.p)) < 4 * math.hypot(found.cov, plain.cov)
    assert "failures may not replay" in found.given
    assert (found.failures.f <= gamma).all()
