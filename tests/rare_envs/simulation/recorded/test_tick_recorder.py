"""Operations are recorded as texts that give the same, or not at all."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from rare_envs.simulation.recorded.tick_recorder import TickRecorder

ROWS = 1009
WHOLE = torch.arange(1)
OWN = torch.full((1,), 2.0)


def record(work: Callable[[Tensor], Any], values: Tensor | None = None) -> list[str]:
    values = torch.linspace(-1.0, 1.0, ROWS) if values is None else values
    with torch.inference_mode(), TickRecorder([values], {}) as recorder:
        work(values)
    return [step.text for part, _ in recorder.parts for step in part.steps]


def test_numbers_and_other_tensors_are_constants() -> None:
    assert record(lambda x: (x * 2.0 + OWN) / 2.0) == [
        "v0 = multiply(i0, c0)",
        "v1 = add(v0, c1)",
        "v2 = divide(v1, c0)",
    ]


def test_the_number_of_rows_is_no_constant() -> None:
    assert record(lambda x: torch.stack((x, x)).view(1, 2, len(x))) == [
        "v0 = concatenate((i0, i0,)).reshape(2, -1)",
        "v1 = v0.reshape(1, 2, n)",
    ]


def test_the_same_is_computed_once_and_what_was_copied_is_not_read_back() -> None:
    def work(x: Tensor) -> Tensor:
        table = torch.stack((x + 1.0, x * 2.0))
        return table.unbind(0)[1] - (x + 1.0)

    assert record(work) == [
        "v0 = add(i0, c0)",
        "v1 = multiply(i0, c1)",
        "v2 = concatenate((v0, v1,)).reshape(2, -1)",
        "v3 = subtract(v1, v0)",
    ]


def test_a_look_ends_a_part() -> None:
    x = torch.zeros(ROWS)
    with torch.inference_mode(), TickRecorder([x], {}) as recorder:
        assert not bool((x > 0.0).any())
        assert not x.count_nonzero()
        assert not x.any()  # which is known
    assert [(part.look, seen) for part, seen in recorder.parts] == [("v0", False), ("i0", False), (None, False)]


def test_an_operation_in_place_is_recorded_in_memory_of_its_own_only() -> None:
    def write(x: Tensor) -> None:
        near = x > 0.0
        at = near.nonzero(as_tuple=True)
        near[at] = x[at] > 0.5

    assert record(write)[-1] == "v0[v1] = v3"
    for view in (lambda x: x, lambda x: (x + 1.0).unbind(0)[0], _stacked):

        def write_to(x: Tensor, view: Callable[[Tensor], Tensor] = view) -> None:
            view(x)[torch.tensor([True])] = 1.0

        with pytest.raises(ValueError):
            record(write_to)


def _stacked(x: Tensor) -> Tensor:
    part = x + 1.0
    torch.stack((part, part))
    return part


@pytest.mark.parametrize(
    ("work", "reason"),
    [
        (lambda x: torch.mm(x[:, None], x[None]), "is not known"),
        (lambda x: x.count_nonzero() + 1, "a count is computed with"),
        (lambda x: x[:1].item(), "is not known"),
        (lambda x: x[0], "has another result"),
        (lambda x: x.view(-1, 1), "sizes may depend on values"),
        (lambda x: torch.add(x, x, alpha=2), "has settings"),
        (lambda x: torch.zeros_like(x, dtype=torch.int64), "has settings"),
        (lambda x: x * WHOLE, "has another result"),
        (lambda x: x + OWN.repeat(ROWS), "is not known"),
        (lambda x: x + torch.from_numpy(np.ones(ROWS, np.float32)), "rows that are no input's"),
    ],
)
def test_what_cannot_be_written_is_refused(work: Callable[[Tensor], Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        record(work)
