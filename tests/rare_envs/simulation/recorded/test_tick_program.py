"""Programs go every way that was recorded, and say where one was not."""

import numpy as np
import pytest
import torch
from torch import Tensor

from rare_envs.simulation.recorded import tick_program
from rare_envs.simulation.recorded.tick_program import FILLED_ROWS, NotRecorded, TickProgram


def tick(x: Tensor, hit: Tensor) -> tuple[Tensor, Tensor]:
    if bool((x > 2.0).any()):
        x = x - 1.0
    elif bool(hit.any()):
        x = x * 3.0
    return x, hit | (x > 1.0)


def test_each_way_is_recorded_when_it_is_gone() -> None:
    program = TickProgram(tick)
    for first, hit in ((0.5, False), (3.0, False), (1.5, True)):
        values = np.array([first, 0.25], np.float32), np.array([hit, False])
        assert program.run(2, *values) is None
        program.record(*values)
        for rows in (values, tuple(np.concatenate((each, each)) for each in values)):
            found = program.run(len(rows[0]), *rows)
            assert found is not None
            for one, other in zip(found, tick(*map(torch.from_numpy, rows)), strict=True):
                assert one.tobytes() == other.numpy().tobytes()


@pytest.mark.parametrize("rows", [1, 2, *FILLED_ROWS])
def test_any_number_of_rows_may_be_recorded_up_to_the_most(rows: int) -> None:
    program, values = TickProgram(tick), (np.full(rows, 3.0, np.float32), np.zeros(rows, bool))
    program.record(*values)
    found = program.run(rows, *values)
    assert found is not None
    assert found[0].tolist() == [2.0] * rows


def test_a_tick_that_goes_too_many_ways_is_not_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tick_program, "MOST_WAYS", 1)
    program = TickProgram(tick)
    program.record(np.zeros(1, np.float32), np.zeros(1, bool))
    with pytest.raises(NotRecorded, match="too many ways"):
        program.record(np.full(1, 3.0, np.float32), np.zeros(1, bool))


def test_a_tick_that_depends_on_more_than_its_values_is_not_recorded() -> None:
    calls: list[int] = []

    def wander(x: Tensor) -> tuple[Tensor]:
        calls.append(len(calls))
        return ((x + 1.0 if len(calls) > 2 else x - 1.0),)

    program = TickProgram(wander)
    program.record(np.zeros(1, np.float32))
    with pytest.raises(NotRecorded, match="depends on more than its values"):
        program.record(np.zeros(1, np.float32))


def test_what_fails_is_not_recorded() -> None:
    with pytest.raises(NotRecorded, match="sigmoid is not known"):
        TickProgram(lambda x: (x.sigmoid(),)).record(np.zeros(1, np.float32))


def test_what_has_no_rows_is_not_recorded() -> None:
    with pytest.raises(NotRecorded):
        TickProgram(lambda speed, time: (speed, time)).record(np.ones(2, np.float32), np.zeros((), np.float32))
