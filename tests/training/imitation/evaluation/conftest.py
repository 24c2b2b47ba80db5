"""Four recorded scenes, and a driver that changes nothing."""

import pytest
import torch

from tests.training.imitation.synthetic_scenes import scenes
from training.imitation.traffic.recording import stack_scenes


@pytest.fixture(scope="session")
def recording():
    return stack_scenes(scenes(4))


@pytest.fixture(scope="session")
def constant():
    def act(features, memory):
        return torch.zeros(*features.shape[:2], 2), None

    return act
