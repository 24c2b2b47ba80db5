"""The cutter of `CutIn-v1` from recorded starts: its mean acceleration over 2 s against what was recorded."""

from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
import torch
from numpy.typing import NDArray

from rare_envs import IDM
from rare_envs.scenarios.base import Scenario
from rare_envs.scenarios.cut_in import CUT_IN_V1, CUTTER_IDM, CutterModel
from rare_envs.simulation.world import Clock, World, rollout
from tests.rare_envs.egos.test_recorded_followers import I80, LATER, STATE, US101, read_i80, read_us101
from tests.training.shared_data import needs_data

SCRIPT = CutterModel(idm=CUTTER_IDM, coolness=None).scenario()
"""The cutter brakes for its lead as in `CutIn-v0`."""


def simulate(state: NDArray[np.float64], scenario: Scenario) -> NDArray[np.float64]:
    """Mean accelerations [m/s^2] of cutters over 2 s, (n,), for 3.35 m in 4 s behind a lead that does not brake."""
    rest = np.tile([3.35, 4.0, 0.0, 0.0, 0.0, 9.0, 0.0, 0.0], (len(state), 1))
    x = torch.from_numpy(np.column_stack([state, rest]))
    later = rollout(World(scenario, clock=Clock(horizon=LATER)), IDM(), x).state.speed[:, 1].numpy()
    return np.asarray((later - state[:, 1]) / LATER)


@pytest.mark.parametrize(
    ("read", "count"),
    [
        pytest.param(read_us101, 37, marks=needs_data(*US101)),
        pytest.param(read_i80, 50, marks=needs_data(*I80)),
    ],
)
def test_cutters_do_what_recorded_ones_did(read: Callable[[str], pd.DataFrame], count: int) -> None:
    """Root mean square error: 0.69 and 0.53 m/s^2 measured; of the script 1.31 and 0.94."""
    events = read("vehicle")
    events = events[(events.gap_ego_cutin >= 1.0) & (events.gap_cutin_lead >= 1.0)]
    recorded = (events.later - events.v_cutin).to_numpy() / LATER
    found, scripted = (
        float(np.sqrt(((simulate(events[STATE].to_numpy(), each) - recorded) ** 2).mean()))
        for each in (CUT_IN_V1, SCRIPT)
    )
    assert len(events) == count
    assert found <= 0.75 < scripted
