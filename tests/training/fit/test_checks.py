"""The human ego and the cutter of `CutIn-v1` from recorded starts, beside what followers and cutters did."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import training.fit.checks as checks
from rare_envs.scenarios.base import load_base
from rare_envs.scenarios.cut_in import CUTTER_IDM, CutterModel
from rare_envs.scenarios.registry import SCENARIOS, find_scenario
from tests.training.shared_data import DATA, needs_data
from training.data.events import ANSWERS, cut_in_events, measure_answers
from training.data.table import synthetic_traffic
from training.fit.checks import check_answers, simulate_answers
from training.recipes.bases import SHIPPED_BASES

SITES = {each.name: each for each in SHIPPED_BASES if each.answers}


def read_site(name: str):
    events, _ = SITES[name].read(DATA)
    return events.joint, events.answers.reshape(-1, 2, 2)


def read_i24():
    """Starts by the radar of an instrumented follower on I-24; the cutter's speed is that of the same 2 s."""
    events = pd.read_csv(DATA / "i24_cut_ins.csv")
    speed = events.speed + events.rel_speed_2s
    starts = np.column_stack([events.speed, speed, speed, events.gap, np.full(len(events), 149.0)])
    answers = np.full((len(events), 2, 2), np.nan)
    answers[:, 0, 0] = (events.speed_2s - events.speed) / 2.0
    answers[:, 0, 1] = np.maximum(-events.least_accel_3s, 0.0)
    return starts, answers


@needs_data("us101_cut_in_events.csv", "ngsim_us101_scenes.parquet", "i80_coifman.parquet", "i24_cut_ins.csv")
@pytest.mark.parametrize(("site", "followers", "cutters"), [("us101", 38, 35), ("i80", 50, 50), ("i24", 98, 0)])
def test_drivers_go_on_as_recorded_ones_did(site, followers, cutters):
    """Root mean square errors of followers 0.68, 0.69, 0.55 m/s^2, of cutters 0.55 and 0.43; nobody braked hard.

    Followers on I-24 would have 0.47 if cutters wished for no more than their own speed, and cutters 0.69 and 0.53.
    """
    found = check_answers(*(read_i24() if site == "i24" else read_site(site)))
    assert [found.get(who, {"events": 0})["events"] for who in ("followers", "cutters")] == [followers, cutters]
    assert found["followers"]["rmse"] <= (0.55 if site == "i24" else 0.75)
    assert found["followers"]["braking"] == 0 and found["followers"]["share_simulated"] < 0.15
    assert found.get("cutters", {"rmse": 0.0})["rmse"] <= 0.75
    shipped = {} if site == "i24" else load_base(find_scenario("rare_envs/CutIn-v1"), site).record["motion"]
    for who, entries in shipped.items():
        assert found[who] == pytest.approx(entries, abs=0.02)


@needs_data("us101_cut_in_events.csv", "ngsim_us101_scenes.parquet", "i80_coifman.parquet")
@pytest.mark.parametrize("site", SITES)
def test_the_script_that_brakes_for_its_lead_is_refuted(site, monkeypatch):
    """Root mean square error of the cutter of `CutIn-v0`: 1.31 and 0.94 m/s^2."""
    script = replace(CUTTER_IDM, desired_speed=1.0)  # no faster than at the start
    monkeypatch.setitem(SCENARIOS, "rare_envs/CutIn-v1", CutterModel(idm=script, coolness=None).scenario())
    monkeypatch.setattr(checks, "DRAWS", 1)
    assert check_answers(*read_site(site))["cutters"]["rmse"] > 0.75


def test_an_answer_is_the_change_of_speed_over_two_seconds():
    """Braking by 2 m/s^2 from 1 s on, by 20 m/s to 14: at 1 s a mean of -2 and a hardest braking near 2 m/s^2."""
    t = 0.1 * np.arange(80)
    speed = 20.0 - 2.0 * np.clip(t - 1.0, 0.0, 3.0)
    position, start = np.append(0.0, np.cumsum(0.1 * speed))[:-1], np.zeros(1, int)
    ((mean, braking),) = measure_answers(start, position, speed, start + 10)
    assert mean == pytest.approx(-2.0)
    assert braking == pytest.approx(2.0, abs=0.2)
    assert np.isnan(measure_answers(start, t, speed, start + 65)).all()  # the track ends before


def test_answers_of_cut_ins_are_those_of_the_table():
    """Speeds swing by 1 m/s, by 1.3 m/s^2 at most."""
    table = synthetic_traffic(seconds=9.0)
    moved = 3.6 * np.clip((table.time - 2.0) / 3.0, 0.0, 1.0) * (table.vehicle == 4)
    cuts = cut_in_events(replace(table, y=table.y + moved, lane=1 + np.searchsorted([3.6, 7.2], table.y + moved)))
    answers = np.column_stack([cuts[name] for name in ANSWERS])
    assert np.isfinite(answers).all() and (np.abs(answers) < 1.4).all()
    assert (np.abs(answers[:, [0, 2]]) > 0.1).all()


def test_followers_brake_hard_where_they_must_and_not_where_nothing_closes():
    near, far = simulate_answers(np.array([[20.0, 12.0, 12.0, 10.0, 40.0], [20.0, 20.0, 20.0, 60.0, 60.0]]), 4)[
        :, :, 0, 1
    ].T
    assert (near > checks.HARD_BRAKING).all() and (far < 1.0).all()
