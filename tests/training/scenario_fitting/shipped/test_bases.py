"""Events of the shipped bases: numbers of events and clusters as the descriptions of the recordings give them."""

import pytest

from rare_envs.scenarios.registry import scenario_named
from tests.training.shared_data import DATA, needs_data
from training.scenario_fitting.shipped.bases import SHIPPED_BASES

COUNTS = {
    ("car_following", "us101"): ((470,), 28, "scene"),
    ("car_following", "i80"): ((152,), 30, "half-minute"),
    ("car_following", "i80-all-pairs"): ((2116,), 34, "half-minute"),
    ("car_following", "i24"): ((98,), 24, "drive"),
    ("rare_envs/CutIn-v1", "us101"): ((38, 259), 17, "scene"),
    ("rare_envs/CutIn-v1", "i80"): ((50, 131), 25, "half-minute"),
    ("rare_envs/CutIn-v0", "us101"): ((38, 265), 17, "scene"),
    ("rare_envs/CutIn-v0", "us101-15-offsets"): ((38, 15), 17, "scene"),
    ("rare_envs/CutIn-v0", "i80"): ((50, 131), 25, "half-minute"),
    ("hard_brake", "us101"): ((41,), 22, "half-minute"),
}


def test_names_and_files_are_unique():
    assert len({(base.scenario, base.name) for base in SHIPPED_BASES}) == len(SHIPPED_BASES)
    assert len({base.file for base in SHIPPED_BASES}) == len(SHIPPED_BASES)
    assert all({"site", "data", "licence"} <= set(base.source) for base in SHIPPED_BASES)


@needs_data("us101_car_following_events.csv", "i24_circles_following.parquet", "lane_change_profiles.parquet")
@pytest.mark.parametrize("base", SHIPPED_BASES, ids=lambda base: f"{base.scenario}-{base.name}")
def test_recorded_events(base):
    events, frequency = base.read(DATA)
    box = scenario_named(base.scenario).parameters
    if (base.scenario, base.name) in COUNTS:
        counts = events.counts
        assert (counts.used, counts.clusters, counts.cluster) == COUNTS[base.scenario, base.name]
    for column, p in zip(events.joint.T, box, strict=False):
        assert ((column >= p.low) & (column <= p.high)).all()
    assert (frequency is None) == ("no_frequency" in base.source)
    if frequency is not None:
        assert 1.0 < frequency.per_hour < 60.0
    if frequency is not None and "CutIn" not in base.scenario:  # the cut-ins are counted in longer recordings
        assert round(frequency.count * frequency.share) == len(events.joint)
