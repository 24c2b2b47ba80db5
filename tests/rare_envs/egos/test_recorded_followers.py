"""The human ego behind recorded cutters: its mean acceleration over 2 s against what the recorded follower did."""

from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
import torch
from numpy.typing import NDArray

import rare_envs
from rare_envs.simulation.world import drive
from tests.training.shared_data import DATA, needs_data

LATER = 2.0
"""Time over which accelerations are compared [s]."""
US101 = ("us101_cut_in_events.csv", "ngsim_us101_scenes.parquet")
I80 = ("i80_coifman_lane_changes.csv", "i80_coifman.parquet")
I24 = ("i24_cut_ins.csv",)
STATE = ["v_ego", "v_cutin", "v_lead", "gap_ego_cutin", "gap_cutin_lead"]


def read_us101(who: str = "ego") -> pd.DataFrame:
    """Starts on US 101, and the speed of the follower, or the cutter, in the mean of 0.6 s around 2 s later."""
    events, keys = pd.read_csv(DATA / US101[0]), ["scene", who, "epoch_ms"]
    events = events[(events.phase == "start") & events.ego.notna() & events["lead"].notna()]
    rows = pd.read_parquet(DATA / US101[1], columns=["scene", "vehicle", "epoch_ms", "speed"])
    both = events[keys].merge(rows, left_on=["scene", who], right_on=["scene", "vehicle"], suffixes=("", "_later"))
    both = both[(both.epoch_ms_later - both.epoch_ms - 1000 * LATER).abs() <= 300]
    return events.merge(both.groupby(keys).speed.mean().rename("later").reset_index(), on=keys)


def read_i80(who: str = "ego") -> pd.DataFrame:
    """Starts on I-80, and the speed of the follower, or the cutter, 20 pictures later."""
    events = pd.read_csv(DATA / I80[0])
    events = events[events.settled & (events.phase == "start") & (events["lead"] > 0) & (events.ego > 0)]
    rows = pd.read_parquet(DATA / I80[1], columns=["vehicle", "frame", "speed"])
    rows = rows.rename(columns={"vehicle": who, "speed": "later"}).assign(frame=rows.frame - round(10 * LATER))
    return events.merge(rows, on=[who, "frame"])


def read_i24() -> pd.DataFrame:
    """Starts by the radar of an instrumented follower on I-24; the cutter's speed is that of the same 2 s."""
    events = pd.read_csv(DATA / I24[0])
    speed = events.speed + events.rel_speed_2s
    named = {"v_ego": events.speed, "v_cutin": speed, "v_lead": speed, "gap_ego_cutin": events.gap}
    return pd.DataFrame({**named, "gap_cutin_lead": 149.0, "later": events.speed_2s})


def simulate(state: NDArray[np.float64], draws: int = 40) -> NDArray[np.float64]:
    """Mean accelerations [m/s^2] over 2 s of human drivers in CutIn-v1, means over draws of their noise, (n,).

    Cutters change by 3.35 m in 4 s, have looked and do not signal: the recordings do not tell who did.
    """
    problem = rare_envs.DrivingProblem("rare_envs/CutIn-v1", ego="human")
    x = np.random.default_rng(0).standard_normal((draws, len(state), problem.dim))
    names = [parameter.name for parameter in problem.world.scenario.parameters]
    given = {"lateral_offset": 3.35, "duration": 4.0, "attention": 0.0, "indicator": -9.0, "lead_braking": 9.0}
    x[..., :5] = state
    for name, value in given.items():
        x[..., names.index(name)] = value
    episodes = drive(problem.world, problem.driver, torch.from_numpy(x.reshape(-1, problem.dim)))
    later = next(episode for tick, episode in enumerate(episodes) if tick == round(LATER / problem.world.clock.dt))
    speed = later.state.speed[:, 0].reshape(draws, -1).mean(0).numpy()
    return np.asarray((speed - state[:, 0]) / LATER)


@pytest.mark.parametrize(
    ("read", "count", "largest"),
    [
        pytest.param(read_us101, 38, 0.75, marks=needs_data(*US101)),
        pytest.param(read_i80, 50, 0.75, marks=needs_data(*I80)),
        pytest.param(read_i24, 98, 0.55, marks=needs_data(*I24)),
    ],
)
def test_followers_do_what_recorded_ones_did(read: Callable[[], pd.DataFrame], count: int, largest: float) -> None:
    """Root mean square error: 0.68, 0.70 and 0.47 m/s^2 measured; without the heuristic 1.20, 1.12 and 0.77."""
    events = read()
    events = events[(events.gap_ego_cutin >= 1.0) & (events.gap_cutin_lead >= 1.0)]
    recorded = (events.later - events.v_ego).to_numpy() / LATER
    error = simulate(events[STATE].to_numpy()) - recorded
    assert len(events) == count
    assert np.sqrt((error**2).mean()) <= largest
