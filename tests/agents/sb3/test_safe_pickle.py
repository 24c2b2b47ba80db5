"""Restricted unpickling opens what is listed, and calls nothing else."""

from __future__ import annotations

import pickle
from collections import OrderedDict
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import TrainFrequencyUnit

from agents.sb3.safe_pickle import ForbiddenObject, open_pickle

contrib = pytest.importorskip("sb3_contrib", reason="sb3-contrib is optional")


@pytest.mark.parametrize(
    "content",
    [
        b"cos\nsystem\n(S'true'\ntR.",
        b"cbuiltins\neval\n(S'1'\ntR.",
        b"\x80\x04\x8c\x08torch.nn\x94\x8c\x11modules.os.system\x94\x93.",  # through attributes
        b"ctorch.nn\nos\n.",
        b"cstable_baselines3.common.vec_env\nSubprocVecEnv\n.",
        b"cgymnasium.spaces\nutils\n.",
    ],
)
def test_only_listed_classes_are_opened(content: bytes) -> None:
    with pytest.raises(ForbiddenObject, match="which may run code"):
        open_pickle(content)


def test_arrays_written_by_numpy_1_are_opened() -> None:
    values = np.arange(6.0).reshape(2, 3)
    old = pickle.dumps(values, protocol=3).replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    assert b"numpy.core" in old
    np.testing.assert_array_equal(open_pickle(old), values)


@pytest.mark.parametrize(
    "value",
    [
        {"gamma": 0.98, "nested": [1, (2.0, None)], "text": "x"},
        spaces.Box(-1.0, 1.0, (3,)),
        spaces.Dict({"a": spaces.Discrete(4), "b": spaces.MultiBinary(2)}),
        np.random.default_rng(3),
        np.float32(2.5),
        OrderedDict(a=1),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_saved_models_hold_survives(value: Any) -> None:
    again = open_pickle(pickle.dumps(value))
    assert type(again) is type(value)
    if isinstance(value, np.random.Generator):
        assert again.random() == value.random()
    else:
        assert again == value


UNIT = b"cstable_baselines3.common.type_aliases\nTrainFrequencyUnit\n"


def test_a_member_of_an_enumeration_is_opened_as_python_3_11_2_wrote_it() -> None:
    assert open_pickle(b"cbuiltins\ngetattr\n(" + UNIT + b"S'EPISODE'\ntR.") is TrainFrequencyUnit.EPISODE
    assert open_pickle(pickle.dumps(TrainFrequencyUnit.STEP)) is TrainFrequencyUnit.STEP


@pytest.mark.parametrize(
    "arguments",
    [
        UNIT + b"S'mro'\n",
        UNIT + b"S'__class__'\n",
        UNIT,
        UNIT + b"I1\n",
        b"ctorch.nn\nModule\nS'forward'\n",
        b"S'text'\nS'format'\n",
        b"cbuiltins\ngetattr\nS'function'\n",
    ],
)
def test_no_other_attribute_is(arguments: bytes) -> None:
    with pytest.raises((ForbiddenObject, TypeError)):
        open_pickle(b"cbuiltins\ngetattr\n(" + arguments + b"tR.")


def test_classes_of_the_listed_families_are_opened() -> None:
    for value in (torch.nn.ReLU, torch.optim.Adam, ActorCriticPolicy):
        assert open_pickle(pickle.dumps(value)) is value


def test_a_damaged_pickle_raises() -> None:
    for content in (b"", b"\x80\x04", pickle.dumps([1, 2])[:-2]):
        with pytest.raises((EOFError, pickle.UnpicklingError)):
            open_pickle(content)
