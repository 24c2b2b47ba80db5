"""Data and sources of small trainings."""

from pathlib import Path

import pytest

from tests.training.imitation.synthetic_scenes import scenes
from training.imitation.traffic import stack_scenes
from training.imitation.train import Source, prepare_data


@pytest.fixture(scope="session")
def data():
    return prepare_data(scenes())


@pytest.fixture
def made_up(monkeypatch):
    """A source that reads nothing from files."""
    monkeypatch.setattr("training.imitation.train.load_scenes", lambda source: (scenes(2), scenes(3)[2:]))
    return Source("data", Path("somewhere/tables"))


@pytest.fixture(scope="session")
def recording():
    return stack_scenes(scenes())
