"""Lane changes: when they begin, their course, and the driver that has them."""

import math
from dataclasses import fields, replace
from itertools import pairwise

import pytest
import torch

from agents import load_driver
from agents.learned.driver import EASED_BEYOND
from agents.learned.rules import (
    LEFT_MARKER_COLUMN,
    RIGHT_MARKER_COLUMN,
    STATE_SIZE,
    ChangeState,
    CollisionAvoidance,
    LaneChanges,
    Seen,
    patience_of,
)
from rare_envs.sensors.lidar import HEADING_COLUMN, LANE_OFFSET_COLUMN
from tests.agents.learned.test_collision_avoidance import seen

WIDTH = 3.6
HAZARD = 0.5
"""[1/s], to either side."""
CHANGES = LaneChanges(coefficients=(math.log(HAZARD), 0.0, 0.0, 0.0, 0.0))
BESIDE = {"range_90": 2.6}
"""A car beside on the right, whose lane is not free for that."""
OTHERS = {"range_36": 11.0, "range_m36": 11.0}
"""Cars two lanes off on either side, so that there are lanes beside, and they are free."""


def on_lane(offset=0.0, heading=0.0, speed=20.0, **beams):
    """Return features of a car on a lane of 3.6 m."""
    features = seen(speed=speed, **beams)
    features[..., LANE_OFFSET_COLUMN], features[..., HEADING_COLUMN] = offset, heading
    features[..., LEFT_MARKER_COLUMN], features[..., RIGHT_MARKER_COLUMN] = 0.5 * WIDTH + offset, 0.5 * WIDTH - offset
    return features


def begin(left=9.0, right=9.0, changes=CHANGES):
    """Return a state with patiences of a left and a right change."""
    state = changes.begin(torch.zeros(1, 1, 2, dtype=torch.float64))
    return state._replace(patience=torch.tensor([[[left, right]]], dtype=torch.float64))


def step(features, state, draws=None, changes=CHANGES, action=(9.0, 9.0)):
    """Return acceleration and yaw rate for a tick, and the state after it, where others are wanted."""
    wanted = torch.tensor([[action]], dtype=torch.float64)
    action, state = changes.step(Seen.read(features), state, draws, wanted, CollisionAvoidance())
    return action[0, 0].tolist(), state


def drive(state, seconds, changes=CHANGES, speed=20.0, y=0.0, heading=0.0, beams=OTHERS):
    """Yield time, y from the middle of the first lane, heading and state of a car that steers by changes alone."""
    for tick in range(round(seconds / 0.1)):
        lane = round(y / WIDTH)
        (_, yaw_rate), state = step(
            on_lane(y - lane * WIDTH, heading, speed, **beams), state, None, changes, (0.0, 0.0)
        )
        yield 0.1 * tick, y, heading, state
        y += speed * math.sin(heading) * 0.1
        heading += 0.1 * yaw_rate * bool(state.side != 0)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_change_begins_when_the_hazard_has_used_up_the_patience(side):
    state = begin(left=1.0, right=9.0) if side < 0 else begin(left=9.0, right=1.0)
    started = next(time for time, _, _, state in drive(state, 5.0) if state.side != 0)
    assert started == pytest.approx(1.0 / HAZARD, abs=0.15)
    assert int(state.side) == 0


def test_the_course_leads_to_the_middle_of_the_next_lane_in_its_time():
    path = list(drive(begin(right=0.0), 5.0))
    across = [y for _, y, _, _ in path]
    changing = [time for time, _, _, state in path if state.side != 0]
    assert changing[-1] - changing[0] == pytest.approx(CHANGES.duration, abs=0.15)
    assert across[-1] == pytest.approx(WIDTH, abs=0.15)  # a tick late
    assert max(across) < WIDTH + 0.1
    assert abs(20.0 * math.sin(path[-1][2])) < 0.2  # across, in m/s
    slow = list(drive(begin(right=0.0), 9.0, speed=4.0))  # takes longer and keeps its heading small
    changing = [time for time, _, _, state in slow if state.side != 0]
    assert changing[-1] - changing[0] == pytest.approx(CHANGES.duration * CHANGES.slow / 4.0, abs=0.5)
    assert max(abs(heading) for _, _, heading, _ in slow) < 0.18
    fast = sum(0.1 for before, after in pairwise(across) if after - before > 0.02)
    assert fast == pytest.approx(3.4, abs=0.2)  # what people take on US 101, in the median


def test_durations_differ_by_the_draw_of_the_moment():
    """The draw of the other side decides, so that it does not depend on the next patience."""
    paces = []
    for draw in (-1.0, 0.0, 1.0):
        draws = torch.tensor([[[draw, 3.0]]], dtype=torch.float64)
        _, state = step(on_lane(**OTHERS), begin(right=0.0), draws)
        paces.append(1.0 / float(state.pace))
        assert float(state.patience[..., 1]) == pytest.approx(float(patience_of(draws)[..., 1]))
    assert paces == pytest.approx([CHANGES.duration * math.exp(CHANGES.spread * draw) for draw in (-1, 0, 1)])


def test_no_change_begins_and_no_patience_is_used_where_there_is_no_room():
    for why, beams, speed in (
        ("nobody shows that there is a lane", {}, 20.0),
        ("somebody is beside", OTHERS | {"range_90": 2.6, "range_m90": 2.6}, 20.0),
        ("somebody ahead there closes fast", OTHERS | {"range_18": 10.0, "rate_18": -8.0, "range_m90": 2.6}, 20.0),
        ("somebody behind there closes fast", OTHERS | {"range_162": 10.0, "rate_162": -8.0, "range_m90": 2.6}, 20.0),
        ("it is too slow", OTHERS, 2.0),
    ):
        _, _, _, state = list(drive(begin(left=0.1, right=0.1), 3.0, speed=speed, beams=beams))[-1]
        assert int(state.side) == 0, why
        assert state.patience.flatten().tolist() == [0.1, 0.1], why


def test_whoever_is_ahead_in_the_new_lane_is_kept_off_until_the_line():
    ahead = {"range_18": 13.0, "rate_18": -1.0} | {"range_m36": 11.0}
    (acceleration, _), state = step(on_lane(**ahead), begin(right=0.0))
    gap, closing = 13.0 * math.cos(math.radians(18)) - 2.5, 1.0 / math.cos(math.radians(18))
    numbers = (torch.tensor(value, dtype=torch.float64) for value in (gap, closing, 20.0))
    assert acceleration == pytest.approx(CollisionAvoidance().bound_acceleration_behind(*numbers).item())
    (acceleration, _), _ = step(on_lane(-1.7, **ahead), state._replace(offset=state.offset + 1.7))
    assert acceleration == 9.0


def test_a_change_under_way_at_the_first_moment_is_taken_up():
    path = list(drive(begin(), 4.0, y=0.8, heading=0.8 / 20.0))
    assert all(int(state.side) == 1 for _, _, _, state in path[:10])
    assert path[-1][1] == pytest.approx(WIDTH, abs=0.15)
    for over_line, side in ((0.4, 0), (0.2, 1)):  # over the line by 0.3 m: there is a lane, though nobody shows it
        _, state = step(on_lane(1.1, 0.36 / 20.0), begin(), changes=replace(CHANGES, over_line=over_line))
        assert int(state.side) == side
    late = list(drive(begin(), 0.3, y=0.0, heading=0.0))[-1][3]
    _, moving = step(on_lane(0.8, 0.8 / 20.0, **OTHERS), late)
    assert int(moving.side) == 0  # at the first moment only: later it may be the noise


# --- the driver ----------------------------------------------------------------------------------


def test_a_ripe_driver_steers_into_the_next_lane_and_keeps_off_whoever_is_ahead_there():
    driver, draws = load_driver("mgail"), torch.zeros(1, 1, 2, 2)
    draws[..., 1, 1] = 8.0  # no patience for a change to the right
    free, ahead = (
        on_lane(**beams).float() for beams in (OTHERS, {"range_18": 10.0, "rate_18": -2.0, "range_m36": 11.0})
    )
    none = torch.zeros(1, 1, 2)
    (action, memory), (behind, _) = (driver.act(each, None, none, driver.begin(draws)) for each in (free, ahead))
    assert float(action[..., 1]) > 0.05
    assert ChangeState.unpack(memory[..., 4:]).side.item() == 1.0
    assert memory.shape == (1, 1, 4 + STATE_SIZE)
    with pytest.raises(ValueError, match=r"Expected memory of shape \(1, 1, 14\)"):
        driver.act(free, None, none, memory[..., :4])
    assert float(behind[..., 0]) == pytest.approx(-2.0)
    assert float(action[..., 0]) > -1.0


def test_hard_braking_is_eased_but_for_the_rule():
    plain = load_driver("mgail?rules=0")
    features = on_lane(range_0=9.0, rate_0=-9.0).float()
    own = float(plain.act(features)[0][..., 0])
    assert own < -EASED_BEYOND
    eased = float(replace(plain, hard_braking=0.7).act(features)[0][..., 0])
    assert eased == pytest.approx(-EASED_BEYOND + 0.7 * (own + EASED_BEYOND))
    assert float(load_driver("mgail").act(features)[0][..., 0]) == pytest.approx(-(9.0**2) / (2.0 * 6.0))
    with pytest.raises(ValueError, match=r"Expected a share of hard braking in \(0, 1\], got 0"):
        replace(plain, hard_braking=0.0)


def test_settings_are_positive_numbers():
    for kind in (CollisionAvoidance, LaneChanges):
        name = fields(kind)[3].name
        for value in (0.0, -1.0, math.nan, math.inf, True, "2"):
            with pytest.raises(ValueError, match=f"Expected {name} of the .* to be a number above 0, finite"):
                kind(**{name: value})
    for coefficients in ((1.0, 2.0), (0.0, 0.0, 0.0, 0.0, math.nan)):
        with pytest.raises(ValueError, match="Expected 5 finite coefficients of the hazard"):
            LaneChanges(coefficients=coefficients)
