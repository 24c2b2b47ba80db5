"""Training of a driver in miniature: seeds, and data that nothing can be learned from."""

import pytest
import torch

from tests.training.imitation.synthetic_scenes import scene, tiny
from training.imitation.fit import make_learner, prepare_data, train_learner


def weights(policy):
    return torch.cat([value.flatten() for value in policy.state_dict().values()])


def test_seeds_decide_the_weights(data):
    first, second, third = (train_learner(make_learner(data, tiny(updates=1, seed=seed))) for seed in (1, 1, 2))
    assert torch.equal(weights(first), weights(second))
    assert not torch.equal(weights(first), weights(third))


def test_scenes_without_followers_are_refused():

    with pytest.raises(ValueError, match="Nobody follows"):
        prepare_data([scene(vehicles=3)])
    with pytest.raises(ValueError, match="got none"):
        prepare_data([])
