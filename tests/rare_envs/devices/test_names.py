"""Devices are found by name, and refused in one line where there are none."""

import pytest
import torch

from rare_envs.devices import find_device


def test_the_cpu_is_always_there() -> None:
    assert find_device("cpu") == torch.device("cpu")


@pytest.mark.parametrize("name", ["gpu", "", "mps", "meta", "cuda:x", None, 3])
def test_what_is_no_name_of_a_device_is_refused(name: object) -> None:
    with pytest.raises(ValueError, match="Expected device 'cpu', 'cuda' or 'cuda:1', got"):
        find_device(name)  # type: ignore[arg-type]


def test_a_gpu_that_is_not_here_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert find_device("cuda").type == "cuda"
    with pytest.raises(ValueError, match=r"device='cuda:1' is not here: torch .* sees 1 GPUs; take 'cpu'"):
        find_device("cuda:1")
