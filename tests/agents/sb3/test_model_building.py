"""Networks are built as the file describes them, but of no more numbers than it holds."""

from __future__ import annotations

import base64
import io
import json
import pickle
import zipfile
from typing import Any

import pytest
import stable_baselines3 as sb3
import torch

from agents.sb3.model_building import SPARE_NUMBERS, _BoundedTensors, build_model, open_objects
from agents.sb3.pickle_values import ForbiddenObject


def saved(**changes: Any) -> bytes:
    """A policy with other settings than it was saved with."""
    good, changed = io.BytesIO(), io.BytesIO()
    sb3.PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8, device="cpu").save(good)
    with zipfile.ZipFile(good) as source, zipfile.ZipFile(changed, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name == "data":
                content = json.dumps({**json.loads(content), **changes}).encode()
            target.writestr(name, content)
    return changed.getvalue()


def test_a_policy_is_built() -> None:
    model = build_model(sb3.PPO, saved(), "ego.zip")
    assert model.observation_space.shape == (3,)


@pytest.mark.parametrize("net_arch", [[3000, 3000], [1] * 9000])
def test_more_numbers_or_layers_than_the_file_holds_are_not_built(net_arch: list[int]) -> None:
    """3000 by 3000 weights of actor and critic are 18 million, the file has 10,000."""
    with pytest.raises(ForbiddenObject, match="networks of more numbers than it holds"):
        build_model(sb3.PPO, saved(policy_kwargs={"net_arch": net_arch}), "ego.zip")


def test_tensors_are_counted_however_they_are_made() -> None:
    makers = [
        torch.empty,
        torch.zeros,
        torch.ones,
        torch.rand,
        torch.randn,
        torch.arange,
        lambda n: torch.full((n,), 1.0),
    ]
    for make in (*makers, torch.eye(2).new_zeros):
        with pytest.raises(ForbiddenObject), _BoundedTensors(1000, 10):
            make(1001)  # type: ignore[operator]
        with pytest.raises(ForbiddenObject), _BoundedTensors(1000, 10):
            [torch.empty(1) for _ in range(11)]
    with _BoundedTensors(1000, 10):
        torch.empty(900)
    assert SPARE_NUMBERS < 2**25


def test_the_entry_that_is_refused_is_named() -> None:
    coded = base64.b64encode(pickle.dumps(print)).decode()
    with pytest.raises(ForbiddenObject, match=r"in its 'policy_kwargs' it asks for builtins\.print"):
        open_objects({"policy_kwargs": {":serialized:": coded}}, set())
    assert open_objects({"seed": {":serialized:": coded}, "gamma": 1}, {"seed"}) == {}
