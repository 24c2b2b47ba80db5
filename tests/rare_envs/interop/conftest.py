"""HighwayEnv's intersection changes the class of all vehicles for good; the next test finds it as it was."""

from collections.abc import Iterator

import pytest
from highway_env.vehicle.behavior import IDMVehicle

from rare_envs.interop.layouts import restore_class_parameters


@pytest.fixture(autouse=True)
def unchanged_class() -> Iterator[None]:
    with restore_class_parameters(IDMVehicle):
        yield
