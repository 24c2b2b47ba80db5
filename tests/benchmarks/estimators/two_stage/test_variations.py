"""Variations of two-stage's settings."""

from benchmarks.estimators.two_stage.variations import VARIATIONS
from benchmarks.samplers.problems import PROBLEMS
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS


def test_each_variation_changes_existing_settings_down_and_up_on_known_problems():
    for variation in VARIATIONS.values():
        assert set(variation.problems) <= PROBLEMS.keys()
        for path, values in variation.values.items():
            group, name = path.split(".")
            default = getattr(getattr(DEFAULT_SETTINGS.mixture, group), name)
            assert default not in values
            assert min(values) < default < max(values)
