"""Measurement of an episode: wrong measures and collisions are refused, and a trace is known to be kept."""

import pytest

from rare_envs.measures import MEASURES
from rare_envs.simulation.measurement import Measurement


def test_unknown_measures_and_collisions_are_refused() -> None:
    with pytest.raises(ValueError, match="did you mean 'ttc'"):
        Measurement("tcc")
    with pytest.raises(ValueError, match="Expected collisions 'ego' or 'any', got 'all'"):
        Measurement(collisions="all")


def test_only_measures_of_whole_episodes_record() -> None:
    assert Measurement("pet").records
    assert not Measurement("ttc").records
    assert Measurement(lambda moment: moment.state.x[:, 0]).episode_measure not in MEASURES.values()
