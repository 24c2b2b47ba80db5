"""Rewards of agents: their terms by hand, and what a reward may be."""

from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

import rare_envs
from rare_envs.multi_agent import adversary_reward, terms_of, total_of

FOLLOWING = "rare_envs/CarFollowing-v0"


def test_rewards_are_those_of_an_ego_in_each_place():
    """Car-following seen by the lead: nobody ahead, so no risk and no headway; its own speed and effort."""
    env = rare_envs.parallel_env(FOLLOWING)
    env.reset(options={"x": [20.0, 15.0, 14.5]})
    _, rewards, *_, infos = env.step({"ego": np.array([0.5, 0.0]), "lead": np.array([-0.5, 0.0])})
    terms = infos["lead"]["reward_terms"]
    assert terms == pytest.approx(
        {"progress": 14.75 / 21.72, "comfort": -0.025, "lane": 0, "risk": 0, "headway": 0, "collision": 0}, abs=1e-6
    )
    assert rewards["lead"] == pytest.approx(sum(terms.values()), abs=1e-6)
    risk = -(1.0 - (14.0 / 5.5) / 4.0)  # closing at 20.25 - 14.75
    assert infos["ego"]["reward_terms"]["risk"] == pytest.approx(risk, abs=1e-6)


def test_the_adversarys_reward_by_hand():
    env = rare_envs.parallel_env(FOLLOWING, agents=["lead"], rewards={"lead": adversary_reward})
    env.reset(options={"x": [20.0, 15.0, 14.5]})
    *_, infos = env.step({"lead": np.array([-1.0, 0.0])})
    terms = infos["lead"]["reward_terms"]
    speed = float(env.state()[0, 3])  # of the ego, which IDM brakes
    assert terms["danger"] == pytest.approx(1.0 - 14.0 / (speed - 14.5) / 4.0, abs=1e-5)
    assert terms["comfort"] == pytest.approx(-0.1)
    assert (terms["collision"], terms["fault"]) == (0.0, 0.0)
    env.reset(options={"x": [20.0, 15.0, 2.0]})
    while env.agents:
        *_, infos = env.step({"lead": np.array([-1.0, 0.0])})
    assert (infos["lead"]["reward_terms"]["collision"], infos["lead"]["reward_terms"]["fault"]) == (30.0, 0.0)
    env.reset(options={"x": [20.0, 20.0, 100.0]})
    while env.agents:
        *_, infos = env.step({"lead": np.array([0.0, 1.0])})
    assert (infos["lead"]["reward_terms"]["collision"], infos["lead"]["reward_terms"]["fault"]) == (0.0, -30.0)


def test_a_reward_is_a_tensor_or_terms_with_a_total():
    class Two(NamedTuple):
        near: Tensor
        far: Tensor

        @property
        def total(self):
            return self.near + 2.0 * self.far

    reward = Two(torch.ones(3), torch.full((3,), 0.25))
    assert torch.equal(total_of(reward), torch.full((3,), 1.5))
    assert list(terms_of(reward)) == ["near", "far"]
    plain = torch.zeros(3)
    assert total_of(plain) is plain
    assert terms_of(plain) == {"reward": plain}
    for wrong in (0.0, torch.zeros(()), torch.zeros(3, 1)):
        with pytest.raises(ValueError, match=r"shape \(B,\)"):
            total_of(wrong)
