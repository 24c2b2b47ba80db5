"""Numbers of compiled measures and terms."""

import numpy as np
import pytest

from rare_envs.simulation.compiled.highway import measure_kinds
from rare_envs.simulation.measurement import Measurement


@pytest.mark.parametrize(
    ("measure", "collisions", "gamma", "kind"),
    [
        ("ttc", "ego", 0.0, measure_kinds.DISTANCES),
        ("ttc", "any", 0.0, measure_kinds.PAIR_DISTANCES),
        ("ttc", "any", 1.5, measure_kinds.LEAD_TIMES),
        ("lidar_ttc", "any", 0.5, measure_kinds.BEAM_TIMES),
        ("clearance", "any", 1.5, measure_kinds.DISTANCES),
        ("clearance", "any", 0.0, measure_kinds.PAIR_DISTANCES),
    ],
)
def test_terms_by_measure_collisions_and_threshold(measure, collisions, gamma, kind):
    assert measure_kinds.find_term_kind(Measurement(measure, collisions), gamma) == kind


def test_numbers_of_measures():
    kinds = [measure_kinds.find_measure_kind(Measurement(name)) for name in (*measure_kinds.MEASURE_KINDS, "thw")]
    assert kinds == [measure_kinds.BY_TTC, measure_kinds.BY_LIDAR, measure_kinds.BY_CLEARANCE, None]


def test_numbers_and_cuts_of_terms():
    assert [measure_kinds.count_terms(kind, 6) for kind in range(5)] == [0, 5, 10, 6, 15]
    assert [measure_kinds.find_cut(kind) for kind in range(5)] == [np.inf, 0.45, 0.05, np.inf, 0.45]
