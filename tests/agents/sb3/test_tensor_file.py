"""Tensors of a `.pth` are those that torch reads, and never more than the file holds."""

from __future__ import annotations

import io
from typing import Any

import pytest
import torch

from agents.sb3.pickle_values import ForbiddenObject
from agents.sb3.tensor_file import STORAGE_DTYPES, read_tensors


def saved(value: Any) -> bytes:
    file = io.BytesIO()
    torch.save(value, file)
    return file.getvalue()


def test_a_state_dict_and_an_optimiser_come_back() -> None:
    network = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.BatchNorm1d(4))
    optimiser = torch.optim.Adam(network.parameters())
    network(torch.randn(5, 3)).sum().backward()
    optimiser.step()
    for state in (network.state_dict(), optimiser.state_dict()):
        content = saved(state)
        assert str(read_tensors(content)) == str(torch.load(io.BytesIO(content), weights_only=True))
    assert read_tensors(saved(network.state_dict()))._metadata == network.state_dict()._metadata


@pytest.mark.parametrize("dtype", STORAGE_DTYPES.values())
def test_every_type_of_number_comes_back(dtype: torch.dtype) -> None:
    values = torch.arange(6).reshape(2, 3).to(dtype)
    for each in (values, values.T, values[:, 1], values[1:], torch.zeros(0, dtype=dtype), torch.tensor(1, dtype=dtype)):
        assert torch.equal(read_tensors(saved(each)), each)


def test_tensors_that_share_memory_still_do() -> None:
    whole = torch.zeros(10)
    first, second = read_tensors(saved([whole, whole[2:4]]))
    first[3] = 1.0
    assert second.tolist() == [0.0, 1.0]


def test_a_tensor_larger_than_its_storage_is_refused() -> None:
    """One number, expanded to a billion, would fill 4 GB in the first copy."""
    with pytest.raises(ForbiddenObject, match="larger than its storage"):
        read_tensors(saved(torch.zeros(1).expand(10**9)))
