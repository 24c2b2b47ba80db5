"""First contacts on a ring: who is behind, across the seam too, and what it would have needed."""

import numpy as np
import pytest
import torch

from benchmarks.driving.flow.long_drives import drive_ticks, start_column
from benchmarks.driving.flow.pile_up import find_first_contacts, look_back
from benchmarks.driving.realism import constant_velocity
from benchmarks.driving.realism_score import by_features

LENGTH = 1600.0


def drive_into_one(shift: float) -> tuple[list, list]:
    """Let vehicle 5 run into vehicle 10, which stands 14 m ahead of it; all moved along the ring."""
    start = start_column(25.0, np.random.default_rng(0))
    x, speed = start.x.clone(), torch.zeros_like(start.speed)
    x[0, 10], speed[0, 5] = x[0, 5] + 5.0 + 14.0, 10.0
    x = torch.remainder(x - x[0, 5] + shift, LENGTH)
    apart = start._replace(x=x, speed=speed)
    ticks = list(drive_ticks(apart, by_features(constant_velocity), LENGTH, seconds=2.0))
    return ticks, find_first_contacts(ticks, LENGTH)


@pytest.mark.parametrize("shift", [800.0, LENGTH - 6.0])
def test_the_one_behind_is_found_across_the_seam_too(shift: float):
    ticks, contacts = drive_into_one(shift)
    (only,) = [contact for contact in contacts if {contact.behind, contact.ahead} == {5, 10}]
    assert (only.behind, only.ahead) == (5, 10) and only.across < 0.1
    assert only.tick in (14, 15)  # 14 m at 10 m/s
    ((gap, own, other, needed, acceleration),) = look_back(ticks, [only], 1.0, LENGTH)
    assert gap == pytest.approx(10.0, abs=1.1) and own == pytest.approx(10.0) and other == pytest.approx(0.0)
    assert needed == pytest.approx(own**2 / (2.0 * gap)) and acceleration == pytest.approx(0.0)


def test_contacts_too_early_for_a_look_back_are_left_out():
    ticks, contacts = drive_into_one(800.0)
    assert look_back(ticks, contacts, 3.0, LENGTH).shape == (0, 5)
