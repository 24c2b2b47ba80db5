"""Processor time of a training by part."""

from benchmarks.simulation import training_shares


def test_parts_are_within_the_whole():
    parts = training_shares.measure_parts(num_envs=4, rollouts=1, n_steps=8, n_epochs=1)
    assert set(parts) == {"simulation", "policy", "updates", "in all"} and min(parts.values()) > 0.0
    assert sum(parts.values()) <= 2.0 * parts["in all"] + 1e-6
