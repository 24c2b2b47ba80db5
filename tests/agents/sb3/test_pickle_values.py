"""Values of a pickle come back as they were; arguments that NumPy would follow into foreign memory are refused."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from agents.sb3.pickle_values import RECONSTRUCTIONS, ForbiddenObject, fill_value, is_array_shape, is_key
from agents.sb3.safe_pickle import open_pickle


@pytest.mark.parametrize("protocol", [3, 4, 5])
@pytest.mark.parametrize(
    "values",
    [
        np.arange(6.0).reshape(2, 3),
        np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)),
        np.array([True, False]),
        np.zeros((0, 4), np.float32),
        np.array(2.5),
        np.arange(3, dtype=">f4"),
        np.arange(10)[::3],
    ],
    ids=str,
)
def test_arrays_come_back(values: np.ndarray, protocol: int) -> None:
    again = open_pickle(pickle.dumps(values, protocol=protocol))
    assert again.dtype == pickle.loads(pickle.dumps(values, protocol=protocol)).dtype  # NumPy may turn the byte order
    np.testing.assert_array_equal(again, values)


@pytest.mark.parametrize(
    ("make", "bits"),
    [  # saved policies have no RandomState of other bits than those of MT19937
        (np.random.Generator, np.random.PCG64),
        (np.random.Generator, np.random.MT19937),
        (np.random.RandomState, np.random.MT19937),
    ],
)
def test_random_generators_go_on(make: Any, bits: Any) -> None:
    generator = make(bits(3))
    generator.normal(size=5)
    again = open_pickle(pickle.dumps(generator))
    assert again.normal() == generator.normal()


@pytest.mark.parametrize("dtype", ["O", "O8", "V8", "S4", "U2", "M8[s]", "f16", "c8", "f8,f4", 3, None, [("a", "O")]])
def test_dtypes_of_numbers_are_made_and_no_others(dtype: Any) -> None:
    with pytest.raises(ForbiddenObject, match="not of numbers"):
        RECONSTRUCTIONS["numpy.dtype"](dtype, False, True)


def test_an_array_is_filled_once() -> None:
    array = RECONSTRUCTIONS["numpy._core.multiarray._reconstruct"]()
    state = (1, (2,), np.dtype("<f8"), False, bytes(16))
    fill_value(array, state)
    with pytest.raises(ForbiddenObject, match="twice"):
        fill_value(array, state)


@pytest.mark.parametrize("value", [print, 3, "text", [1], np.float64, object()])
def test_other_things_are_not_filled(value: Any) -> None:
    with pytest.raises(ForbiddenObject, match="contents of"):
        fill_value(value, {"a": 1})


def test_shapes_and_keys() -> None:
    assert all(map(is_array_shape, [(), (3,), (0, 2**30)]))
    assert not any(map(is_array_shape, [(-1,), (2**31,), (True,), [3], (1.0,), (1,) * 9]))
    assert all(map(is_key, ["a", 1, 2.5, None, (1, "a"), b"x"]))
    assert not any(map(is_key, [((1,),), [1], (1,) * 9, frozenset((1,))]))
