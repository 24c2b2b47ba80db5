"""Texts of operations compute with NumPy what torch computes."""

from typing import Any

import numpy as np
import pytest
import torch

from rare_envs.simulation.recorded.array_operations import FUNCTIONS, fill_like, write_operation

A, B = torch.tensor([[0.5, -2.0, torch.nan], [torch.inf, 0.0, 3.5]]), torch.tensor([[1.5, -2.0, 1.0], [0.25, 0.0, 2.5]])
FEW = torch.tensor([0.0, 1.0, 0.3])
ZEROS = torch.tensor([0.0, -0.0]).repeat(9)


@pytest.mark.parametrize(
    ("name", "args", "expected"),
    [
        ("add", (A, B), A + B),
        ("rsub", (A, B), B - A),
        ("div", (A, B), A / B),
        ("clamp_min", (A, B), torch.maximum(A, B)),
        ("clamp_max", (A, B), torch.minimum(A, B)),
        *(
            (name, (ZEROS, bound), getattr(ZEROS, name)(bound.item()))
            for name in ("clamp_min", "clamp_max", "clamp")
            for bound in (torch.tensor(0.0), torch.tensor(-0.0))
        ),
        ("clamp", (A, None, B), torch.minimum(A, B)),
        ("clamp", (A, B), torch.maximum(A, B)),
        ("round", (A,), A.round()),
        ("where", (A > B, A, B), torch.where(A > B, A, B)),
        ("bitwise_not", (A > B,), ~(A > B)),
        ("any", (A > B, 1), (A > B).any(1)),
        ("stack", ([FEW, FEW + 1.0],), torch.stack((FEW, FEW + 1.0))),
        ("slice", (A, 1, 1, 2**63 - 1), A[:, 1:]),
        ("slice", (A, 0, None, 1), A[:1]),
        ("select", (A, 1, 2), A[:, 2]),
        ("index", (A, [None, torch.tensor([2, 0])]), A[:, [2, 0]]),
        ("view", (A, [3, 2]), A.view(3, 2)),
        ("mT", (A,), A.mT),
        ("numpy_T", (A,), A.T),
        ("expand_as", (FEW, A), FEW.expand_as(A)),
        ("zeros_like", (A,), torch.zeros_like(A)),
        ("full_like", (A, 2.5), torch.full_like(A, 2.5)),
        *((name, (FEW,), getattr(FEW, name)()) for name in ("asin", "atan", "cos", "sin", "sqrt", "tan")),
        *((name, (-0.0 * FEW,), getattr(-0.0 * FEW, name)()) for name in ("cos", "sin", "sqrt")),
    ],
)
def test_an_operation_has_the_same_bits(name: str, args: tuple[Any, ...], expected: torch.Tensor) -> None:
    values: dict[str, Any] = {}

    def write(argument: Any) -> Any:
        if isinstance(argument, list):
            return [write(each) for each in argument]
        if not isinstance(argument, torch.Tensor):
            return argument
        values[f"a{len(values)}"] = argument.numpy()
        return f"a{len(values) - 1}"

    text = write_operation(name, [write(each) for each in args])
    assert text is not None
    with np.errstate(all="ignore"):
        found = eval(text, FUNCTIONS, values)
    assert found.dtype == expected.numpy().dtype
    assert np.array_equal(found, expected.numpy(), equal_nan=found.dtype == np.float32)
    assert (
        np.array_equal(np.signbit(found), expected.signbit().numpy()) or found.dtype == bool or name == "div"
    )  # 0 / 0


def test_several_results_are_unpacked() -> None:
    table = np.arange(6.0).reshape(2, 3)
    for axis, expected in ((0, list(table)), (1, list(table.T))):
        found = eval(str(write_operation("unbind", ("table", axis))), FUNCTIONS, {"table": table})
        assert np.array_equal(list(found), expected)
    assert [each.tolist() for each in eval(str(write_operation("nonzero_numpy", ("t",))), FUNCTIONS, {"t": table})] == [
        [0, 0, 1, 1, 1],
        [1, 2, 0, 1, 2],
    ]


def test_an_operation_in_place_writes() -> None:
    text, table = write_operation("index_put_", ("table", ["at"], "new")), np.zeros(3)
    exec(str(text), {"table": table, "at": np.array([2]), "new": 1.0})
    assert table.tolist() == [0.0, 0.0, 1.0]


@pytest.mark.parametrize(("name", "args"), [("mm", ("a", "b")), ("slice", ("a", -1, 0, 3)), ("stack", (["a"], 1))])
def test_what_is_not_known_has_no_text(name: str, args: tuple[Any, ...]) -> None:
    assert write_operation(name, args) is None


def test_a_filled_array_has_the_others_form() -> None:
    assert fill_like(np.zeros((1, 2), np.float32), 3).tolist() == [[3.0, 3.0]]
