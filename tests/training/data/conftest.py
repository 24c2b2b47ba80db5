"""Simulated traffic, once as arrays and once in the files of each format."""

import pytest

from tests.training.data.recordings import ROAD, simulate, write_highd, write_ngsim


@pytest.fixture(scope="session")
def traffic():
    return simulate(0, lanes=3, per_lane=8, seconds=14.0)


@pytest.fixture(scope="session")
def ngsim(traffic, tmp_path_factory):
    path = tmp_path_factory.mktemp("ngsim") / "trajectories-us101.csv"
    return path, write_ngsim(path, traffic, ROAD)


@pytest.fixture(scope="session")
def highd(traffic, tmp_path_factory):
    folder = tmp_path_factory.mktemp("highd")
    lower = simulate(1, lanes=2, per_lane=6, seconds=10.0)
    return folder, write_highd(folder, traffic, lower, road=ROAD), lower
