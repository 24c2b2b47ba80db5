"""HighwayEnv's intersection changes the class of all vehicles for good; the next test finds it as it was."""

from collections.abc import Iterator

import pytest
from highway_env.vehicle.behavior import IDMVehicle

from rare_envs.interop.parameters import class_kept


@pytest.fixture(autouse=True)
def unchanged_class() -> Iterator[None]:
    with class_kept(IDMVehicle):
        yield
