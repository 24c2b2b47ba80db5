"""Moments: the lead whose gap is measured is the one whose acceleration counts."""

import numpy as np
import torch

from rare_envs.traffic.lead import lead_index, lead_of
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import State
from tests.rare_envs.measures.moments import F64


def test_lead_index_is_whose_gap_is_measured() -> None:
    rng = np.random.default_rng(5)
    state = State(
        torch.from_numpy(rng.uniform(-40.0, 40.0, (400, 5))),
        torch.from_numpy(rng.uniform(-2.0, 6.0, (400, 5))),
        torch.zeros(400, 5, dtype=F64),
        torch.ones(400, 5, dtype=F64),
        torch.zeros(400, 0, dtype=F64),
    )
    gap, index = lead_of(state, straight(2)).gap, lead_index(state, straight(2))
    has = index > 0
    assert 100 < has.sum() < 399
    assert torch.equal(torch.isinf(gap), ~has)
    ahead = state.x.gather(1, index[:, None])[:, 0] - state.x[:, 0] - 5.0
    torch.testing.assert_close(ahead[has], gap[has])
