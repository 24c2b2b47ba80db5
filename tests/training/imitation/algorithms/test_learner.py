"""Trainings in progress: resumed as if never stopped, rates that fall, random numbers of their own."""

import pytest
import torch

from tests.training.imitation.synthetic_scenes import tiny
from training.imitation.fit import make_learner, train_learner


def weights(policy):
    return torch.cat([value.flatten() for value in policy.state_dict().values()])


@pytest.mark.parametrize("method", ["gail", "mgail"])
def test_a_killed_training_resumes_to_the_same_weights(data, method, tmp_path):
    config = tiny(method=method)
    whole = train_learner(make_learner(data, config))
    stopped = make_learner(data, config)

    class Killed(Exception):
        pass

    save = stopped.save

    def save_and_die(path):
        save(path)
        raise Killed

    stopped.save = save_and_die
    with pytest.raises(Killed):
        train_learner(stopped, tmp_path, every=3)
    assert stopped.update == 3
    resumed = train_learner(make_learner(data, config), tmp_path, every=3)
    assert torch.equal(weights(resumed), weights(whole))
    assert not torch.equal(weights(make_learner(data, config).policy), weights(whole))


def test_the_learner_uses_them(data):
    learner = make_learner(data, tiny(updates=2, anneal=0.5, policy_rate=3e-4, critic_rate=4e-4))
    train_learner(learner)
    (group,) = learner.policy_optimiser.param_groups
    assert group["lr"] == pytest.approx(3e-4)
    learner.update = 2
    learner.set_rates()
    assert learner.critic_optimiser.param_groups[0]["lr"] == pytest.approx(4e-5)
    assert learner.policy_optimiser.param_groups[0]["lr"] == pytest.approx(3e-5)


def test_nothing_is_drawn_from_the_global_generator(data):
    before = torch.get_rng_state()
    train_learner(make_learner(data, tiny(method="gail", updates=1)))
    assert torch.equal(torch.get_rng_state(), before)
