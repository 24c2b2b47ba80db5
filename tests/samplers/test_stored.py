"""Results in files, and tables of points."""

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

import samplers
from samplers.output import StoredMethod, read_object, register_stored, write_object


@dataclass(frozen=True)
class Thing:
    value: object
    parts: tuple["Thing", ...] = ()
    derived: int = field(default=0, init=False)


register_stored(Thing)


VALUES = [None, True, -3, "text", 0.1 + 0.2, math.inf, -math.inf, (1, (2.5, "a")), [1, [2]], {"a": (1,), 2: None}]


@pytest.mark.parametrize("value", [*VALUES, samplers.Status.BUDGET, np.float64(0.1)])
def test_values_come_back_as_they_were(tmp_path, value):
    write_object(tmp_path / "thing", Thing(value, (Thing("inside"), Thing(math.nan))))
    found = read_object(tmp_path / "thing", Thing)
    assert (found.value, found.parts[0]) == (value, Thing("inside"))
    assert type(found.value) in (type(value), float)
    assert math.isnan(found.parts[1].value)


@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).reshape(2, 3).T,
        np.broadcast_to(0.25, 4),
        np.empty((0, 3)),
        np.array([np.nan, -np.inf]),
        np.array([True, False]),
        np.arange(3),
        np.array(2.5),
    ],
    ids=["transposed", "broadcast", "empty", "nan", "bool", "whole", "scalar"],
)
def test_arrays_come_back_with_their_bits(tmp_path, array):
    write_object(tmp_path / "thing", Thing(array))
    found = read_object(tmp_path / "thing", Thing).value
    assert found.dtype == array.dtype
    np.testing.assert_array_equal(found, array)


def test_other_classes_are_refused_when_written(tmp_path):
    with pytest.raises(TypeError, match="class function cannot be written"):
        write_object(tmp_path / "thing", Thing(lambda: 0))


def test_a_name_belongs_to_one_class():
    with pytest.raises(ValueError, match="Another class named Thing"):
        register_stored(dataclass(type("Thing", (), {})))


@pytest.mark.parametrize("cut", [0, 5, 60, -1])
def test_a_file_that_was_cut_is_refused_in_one_line(tmp_path, cut):
    path = tmp_path / "thing"
    write_object(path, Thing(np.arange(100.0)))
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(ValueError, match="damaged") as error:
        read_object(path, Thing)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"samplers 1", b"samplers 2"),
        (b'\\"object\\"', b'\\"obxect\\"'),
        (b"Thing", b"Thong"),
        (b'\\"value\\"', b'\\"valve\\"'),
        (b'\\"array0\\"', b'\\"array9\\"'),
    ],
)
def test_a_file_that_was_changed_is_refused_in_one_line(tmp_path, old, new):
    path = tmp_path / "thing"
    write_object(path, Thing(np.arange(3.0)))
    assert old in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(old, new))
    with pytest.raises(ValueError, match="damaged") as error:
        read_object(path, Thing)
    assert "\n" not in str(error.value)


def test_a_file_of_something_else_is_refused(tmp_path):
    write_object(tmp_path / "thing", Thing(1))
    with pytest.raises(ValueError, match="got Thing"):
        read_object(tmp_path / "thing", samplers.Level)
    with pytest.raises(FileNotFoundError, match="no file"):
        read_object(tmp_path / "nothing", Thing)


def test_a_folder_in_place_of_the_file_is_named(tmp_path):
    with pytest.raises(OSError, match=r"Cannot write '.*': "):
        write_object(tmp_path, Thing(1))


class Other(samplers.Method):
    name, stops_at_target = "other", False

    def steps(self, inputs, goal, rng):
        f = yield inputs.base.sample(100, rng)
        return samplers.Outcome.of_counts(int((f <= goal.gamma).sum()), 100, goal.confidence, trace=())


def test_a_method_of_another_package_keeps_its_name(tmp_path):
    problem = samplers.FunctionProblem(lambda x: x[:, 0], dim=1)
    result = samplers.estimate(problem, Other(), seed=0)
    result.save(tmp_path / "result")
    found = samplers.Estimate.load(tmp_path / "result")
    assert found.method == StoredMethod("other", False)
    assert str(found) == str(result)
    with pytest.raises(ValueError, match="cannot run"):
        samplers.estimate(problem, found.method)
