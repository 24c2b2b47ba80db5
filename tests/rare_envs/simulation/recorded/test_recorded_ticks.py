"""Recorded ticks give the bits of torch, and leave to it what they cannot."""

import copy
import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import rare_envs
from rare_envs.control.idm import IDM
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.scenarios.cut_in import CUT_IN
from rare_envs.simulation.clock import Clock
from rare_envs.simulation.measurement import Measurement
from rare_envs.simulation.recorded import RecordedTicks, recorded_ticks
from rare_envs.simulation.recorded.tick_program import NotRecorded, TickProgram
from rare_envs.simulation.rollout import drive, rollout
from rare_envs.simulation.world import World

X = torch.tensor([[20.0, 12.0, 12.0, 20.0, 40.0, 3.5], [30.0, 25.0, 9.0, 20.0, 40.0, 3.5]])
SIZES = (1, 2, 25, 100, 333, 600)


def draw(env_id: str, rows: int, **settings: Any) -> tuple[rare_envs.DrivingProblem, torch.Tensor]:
    """Return a problem, and scenarios from its base and from anywhere in the box, half of each."""
    problem, rng = (
        rare_envs.DrivingProblem(f"rare_envs/{env_id}", core="torch", **settings),
        np.random.default_rng(rows),
    )
    low, high = problem.space.low, problem.space.high
    x = np.concatenate(
        (problem.base.sample(rows, rng)[: rows // 2], rng.uniform(low, high, (rows - rows // 2, len(low))))
    )
    return problem, torch.from_numpy(x).float()


@pytest.mark.parametrize(
    ("env_id", "settings"),
    [
        ("CarFollowing-v0", {}),
        ("CutIn-v0", {}),
        ("CutIn-v1", {}),
        ("HardBrake-v0", {}),
        ("CutIn-v0", {"collisions": "any"}),
        ("CarFollowing-v0", {"horizon": 3.0, "dt": 0.05}),
        ("CutIn-v0", {"ego": IDM(desired_speed=30.0, cut_off=True, added_length=1.0), "horizon": 5.0}),
        ("CutIn-v0", {"measure": "drac"}),
    ],
)
def test_every_number_of_rows_has_the_bits_of_torch(env_id: str, settings: dict[str, Any]) -> None:
    problem, _ = draw(env_id, 2, **settings)
    ticks, failures = RecordedTicks(problem.driver), 0
    for rows in (2, *SIZES):
        _, x = draw(env_id, rows, **settings)
        with torch.inference_mode():
            found, expected = ticks(problem.world, x), rollout(problem.world, problem.driver, x)
        if found is None:
            assert rows == 2  # the first time
            continue
        for one, other in zip(recorded_ticks._tensors_of(found), recorded_ticks._tensors_of(expected), strict=True):
            assert one.contiguous().numpy().tobytes() == other.contiguous().numpy().tobytes()
        failures += int(found.collided.sum())
    assert failures


def test_the_tick_of_a_collision_is_that_of_torch() -> None:
    _, x = draw("CutIn-v0", 200)
    with torch.inference_mode():
        hits = torch.stack([each.collided for each in drive(World(CUT_IN), IDM(), x)])
        for horizon in (1.0, 4.0, 7.5):
            world, ticks = World(CUT_IN, clock=Clock(horizon=horizon)), RecordedTicks(IDM())
            ticks(world, x)
            found = ticks(world, x)
            assert found is not None
            assert torch.equal(found.collided, hits[world.clock.ticks])


@pytest.mark.parametrize("measure", ["pet", "clearance", "lidar_ttc"])
def test_what_is_not_known_is_left_to_torch_for_good(measure: str, monkeypatch: pytest.MonkeyPatch) -> None:
    tried, record = [], TickProgram.record

    def count(self: TickProgram, *values: Any) -> None:
        tried.append(values)
        record(self, *values)

    monkeypatch.setattr(TickProgram, "record", count)
    world, ticks = World(CUT_IN, measurement=Measurement(measure)), RecordedTicks(IDM())
    with torch.inference_mode():
        assert [ticks(world, X) for _ in range(4)] == [None] * 4
    assert len(tried) == 1


def test_drivers_of_users_are_left_to_torch() -> None:
    class Hesitant(IDM):
        """May do anything."""

    ticks = RecordedTicks(Hesitant())
    with torch.inference_mode():
        assert [ticks(World(CUT_IN), X) for _ in range(3)] == [None] * 3


def test_measures_of_users_are_not_compared() -> None:
    class Gap:
        """Equal to nothing that it can tell."""

        __hash__ = object.__hash__

        def __call__(self, moment: Any) -> torch.Tensor:
            return moment.lead.gap

        def __eq__(self, other: object) -> bool:
            raise AssertionError

    ticks = RecordedTicks(IDM())
    with torch.inference_mode():
        for measure in (Gap(), "ttc", Gap()):
            ticks(World(CUT_IN, measurement=Measurement(measure)), X)
    assert len(ticks._known) == 1


class Watch(TorchDispatchMode):
    """Counts operations of torch."""

    count = 0

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += 1
        return func(*args, **(kwargs or {}))


def test_nothing_is_recorded_where_gradients_are_taken() -> None:
    ticks, world = RecordedTicks(IDM()), World(CUT_IN)
    assert [ticks(world, X) for _ in range(3)] == [None] * 3
    assert not ticks._known


def test_double_precision_is_left_to_torch() -> None:
    ticks, world = RecordedTicks(IDM()), World(CUT_IN)
    with torch.inference_mode():
        assert [ticks(world, X.double()) for _ in range(3)] == [None] * 3
        ticks(world, X)
        found = ticks(world, X)
    assert found is not None
    assert found.f.dtype == torch.float32


def test_who_watches_torch_sees_all_of_it() -> None:
    problem, x = draw("CutIn-v0", 8)
    counts = []
    for _ in range(3):
        with Watch() as watch:
            problem.evaluate(x.double().numpy())
        counts.append(watch.count)
        problem.evaluate(x.double().numpy())
    assert counts[0] == counts[2] > 100 * problem.world.clock.ticks


def test_gradients_go_through_torch() -> None:
    problem, row = draw("CarFollowing-v0", 2)[0], [[30.0, 10.0, 60.0]]
    for _ in range(2):
        problem.evaluate(row)
    assert problem.gradient is not None
    leaf = torch.tensor(row, requires_grad=True)
    end = problem._core.roll_out(problem.world, leaf) or rollout(problem.world, problem.driver, leaf)
    end.f.sum().backward()
    assert leaf.grad is not None
    assert bool(leaf.grad.ne(0.0).any())


def test_copies_record_for_themselves() -> None:
    problem, x = draw("CutIn-v0", 8)
    expected = [problem.evaluate(x.double().numpy()) for _ in range(2)][1]
    for other in (pickle.loads(pickle.dumps(problem)), copy.deepcopy(problem)):
        assert not other._core._recorded_ticks._known
        for _ in range(2):
            assert other.evaluate(x.double().numpy()).tobytes() == expected.tobytes()


def test_another_driver_has_other_ticks() -> None:
    problem, x = draw("CarFollowing-v0", 8)
    for _ in range(2):
        problem.evaluate(x.double().numpy())
    problem.driver = IDM(max_deceleration=1.0)
    found = [problem.evaluate(x.double().numpy()) for _ in range(2)]
    with torch.inference_mode():
        expected = rollout(problem.world, problem.driver, x).f
    assert found[0].tolist() == found[1].tolist() == expected.tolist()


def test_what_was_not_simulated_for_longest_goes_first() -> None:
    ticks = RecordedTicks(IDM())
    worlds = [World(CAR_FOLLOWING, clock=Clock(horizon=0.1 * n)) for n in range(1, recorded_ticks.MOST_WORLDS + 2)]
    with torch.inference_mode():
        for world in (*worlds[:-1], replace(worlds[0]), worlds[-1]):
            ticks(world, X[:, :3])
    assert [known.world for known in ticks._known] == [*worlds[2:-1], worlds[0], worlds[-1]]


def test_a_way_that_leads_elsewhere_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TickProgram, "record", lambda self, *values: None)
    ticks = recorded_ticks._WorldTicks(World(CUT_IN), IDM())
    with torch.inference_mode():
        assert ticks.play(X) is None
        assert ticks._program is None
    with pytest.raises(NotRecorded, match="another way"):
        ticks._record(TickProgram(ticks._tick), (X.numpy(),))
