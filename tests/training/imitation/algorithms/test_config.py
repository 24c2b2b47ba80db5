"""Settings: schedules and ranges."""

import pytest

from training.imitation.algorithms.config import Config


def test_learning_rates_fall_after_the_schedules():
    config = Config(updates=1000, anneal=0.7, last_rate=0.1)
    assert [config.rate_factor(update) for update in (0, 700, 850, 1000)] == pytest.approx([1.0, 1.0, 0.55, 0.1])


@pytest.mark.parametrize(
    "settings",
    [
        {"method": "sac"},
        {"updates": 0},
        {"epochs": -1},
        {"pools": 0},
        {"horizon": (15, 0)},
        {"clone_weight": (0.1, 0.0)},
        {"policy_rate": float("nan")},
        {"edge_weight": -1.0},
        {"discount": 1.1},
        {"anneal": 0.0},
        {"last_rate": 2.0},
    ],
)
def test_settings_are_checked(settings):
    with pytest.raises(ValueError, match=f"Expected {next(iter(settings))}"):
        Config(**settings)
