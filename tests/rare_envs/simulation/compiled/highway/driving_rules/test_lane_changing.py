"""Compiled lane changes against `LaneChanges.step`: what vehicles keep in mind, tick after tick."""

import numpy as np
import pytest
import torch

from agents.learned.lane_changes import ChangeState
from rare_envs.simulation.compiled.highway.driving_rules import lane_changing
from rare_envs.simulation.compiled.highway.driving_rules.lanes_beside import look_beside
from rare_envs.simulation.compiled.highway.driving_rules.rule_numbers import (
    CHANGE_SHARE,
    CHANGE_SIDE,
    HAS_CROSSED,
    PATIENCES,
    UNSEEN_TIMES,
)
from tests.rare_envs.simulation.compiled.highway.driving_rules.scenes import (
    CHANGES,
    N,
    beams_of,
    draw_features,
    own_motions,
    single_settings,
)


def carry_on(mind, i, features, draws, settings):
    """Let a vehicle live through a tick, but for the time that passes on its course."""
    beams, own = beams_of(features), own_motions(features)[i]
    lanes = look_beside(beams, i, own, settings)
    lane_changing.remember_lanes(mind, *lanes, own)
    if mind[CHANGE_SHARE] == lane_changing.UNSTARTED:
        lane_changing.take_up_change(mind, *lanes, own, settings)
    lane_changing.begin_change(mind, *lanes, beams, i, own, tuple(draws[i]), settings)
    lane_changing.end_change(mind, *lanes, own, settings)


@pytest.mark.parametrize("kind", CHANGES)
def test_what_is_kept_in_mind(kind):
    """Scenes follow each other without reason, so that lines are crossed and changes begin and end at any time."""
    changes, rng = CHANGES[kind], np.random.default_rng(4)
    settings, seen = single_settings(changes), {"begun": 0, "ended": 0, "crossed": 0, "taken up": 0}
    state = changes.begin(torch.from_numpy(rng.normal(size=(N, 1, 2))).float())
    for tick in range(12):
        features, draws = draw_features(rng), rng.normal(size=(N, 2)).astype(np.float32)
        before = state.pack()[:, 0].numpy()
        _, after = changes.step(features[:, None], state, torch.from_numpy(draws)[:, None])
        expected, minds = after.pack()[:, 0].numpy().copy(), before.copy()
        for i in range(0, N, 2):
            carry_on(minds[i], i, features, draws, settings)
        at_start = expected[:, CHANGE_SHARE] - minds[:, CHANGE_SHARE]
        assert ((at_start[::2] >= -1e-6) & (at_start[::2] <= 0.1)).all()  # the time of this tick has not passed
        minds[:, CHANGE_SHARE] = expected[:, CHANGE_SHARE]
        np.testing.assert_allclose(minds[::2], expected[::2], rtol=1e-4, atol=1e-5)
        was, now = before[::2, CHANGE_SIDE] != 0.0, minds[::2, CHANGE_SIDE] != 0.0
        seen["taken up" if tick == 0 else "begun"] += (now & ~was).sum()
        seen["ended"] += (was & ~now).sum()
        seen["crossed"] += (minds[::2, HAS_CROSSED] > before[::2, HAS_CROSSED]).sum()
        share = torch.from_numpy(rng.uniform(0.0, 1.6, (N, 1))).float()  # some are at the end of their time
        state = after._replace(share=torch.where(after.side != 0.0, share, after.share))
    assert min(seen.values()) > 3, seen


def test_who_has_used_up_its_patience_begins():
    mind = ChangeState.unpack(torch.zeros(1, 10)).pack()[0].numpy()
    mind[PATIENCES : PATIENCES + 2], mind[UNSEEN_TIMES : UNSEEN_TIMES + 2] = (9.0, 0.0), 0.0
    features = draw_features(np.random.default_rng(5))
    draws = np.zeros((N, 2), np.float32)
    carry_on(mind, 0, features, draws, single_settings(CHANGES["waiting"]))
    assert mind[CHANGE_SIDE] == 1.0 and mind[PATIENCES + 1] == np.float32(np.log(2.0)) and mind[CHANGE_SHARE] == 0.0
