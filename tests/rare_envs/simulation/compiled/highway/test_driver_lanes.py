"""Compiled drivers against the learned drivers that they are read from."""

import numpy as np
import torch

import agents
from rare_envs.simulation.compiled.highway import driver_lanes, read_dense_driver
from rare_envs.simulation.compiled.highway.lidar_lanes import BEAM_FIELDS, LOOKING

DRIVER = agents.load_driver("mgail")
DENSE = read_dense_driver(DRIVER)
NUMBERS = driver_lanes.DriverNumbers.of(DENSE)
DRIVERS = 128


def seen_features() -> torch.Tensor:
    """What drivers may perceive, shape (DRIVERS, 51)."""
    generator = torch.Generator().manual_seed(4)
    scaling = DRIVER.policy.scaling
    features = scaling.feature_mean + 2.0 * scaling.feature_std * torch.randn(DRIVERS, 51, generator=generator)
    features[:, 0] = 0.5 * (features[:, 6] - features[:, 7])  # offset, from the markers
    features[:, 3:5], features[:, 8:11] = torch.tensor([5.0, 2.0]), 0.0
    return features


def filled_buffers(features: torch.Tensor) -> driver_lanes.DriverBuffers:
    buffers = driver_lanes.DriverBuffers.of(DENSE, DRIVERS)
    beams = np.zeros((20, BEAM_FIELDS * LOOKING), np.float32)
    beams[:, :DRIVERS], beams[:, LOOKING : LOOKING + DRIVERS] = features[:, 11:31].T, features[:, 31:].T
    driver_lanes.write_beam_features(buffers.features, beams, NUMBERS)
    for lane, (_, heading, speed, _, _, curvature, left, right, *_) in enumerate(features.numpy()):
        driver_lanes.write_own_features(buffers.features, lane, heading, speed, curvature, left, right, NUMBERS)
    return buffers


def test_features_are_normalised_as_the_network_does():
    features = seen_features()
    expected = DRIVER.policy.normalise(features).numpy()
    assert np.allclose(filled_buffers(features).features[:51].T, expected, rtol=1e-5, atol=1e-5)


def test_actions_with_own_weights_and_coloured_noise():
    features, generator = seen_features(), torch.Generator().manual_seed(5)
    weights = torch.from_numpy(DRIVER.weights.sample(DRIVERS, np.random.default_rng(0))).float()
    draws, memory = torch.randn(DRIVERS, 1, 2, generator=generator), torch.randn(DRIVERS, 1, 2, 2, generator=generator)
    with torch.no_grad():
        action, after = DRIVER.act(features[:, None], weights, draws, memory)
    buffers = filled_buffers(features)
    buffers.head[:] = weights.T.numpy()
    driver_lanes.apply_drivers(NUMBERS, buffers)
    kept, found = memory[:, 0].numpy().copy(), []
    for lane in range(DRIVERS):
        noise = driver_lanes.next_noise(kept[lane], draws[lane, 0].numpy(), NUMBERS)
        found.append(driver_lanes.decide_action(buffers.outputs, lane, noise, NUMBERS))
    assert np.allclose(found, action[:, 0].numpy(), atol=2e-5)
    assert np.allclose(kept, after[:, 0].numpy(), atol=1e-6)
    limits = np.array([DENSE.low, DENSE.high])
    assert (found >= limits[0] - 1e-6).all() and (found <= limits[1] + 1e-6).all()


def test_mean_actions_of_the_own_weights():
    features = seen_features()
    with torch.no_grad():
        action, _ = DRIVER.act(features[:, None])
    buffers = filled_buffers(features)
    driver_lanes.apply_drivers(NUMBERS, buffers)
    noise = driver_lanes.NO_NOISE
    found = [driver_lanes.decide_action(buffers.outputs, lane, noise, NUMBERS) for lane in range(DRIVERS)]
    assert np.allclose(found, action[:, 0].numpy(), atol=2e-5)


def test_a_driver_does_not_depend_on_those_beside_it():
    features = seen_features()
    buffers, turned = filled_buffers(features), filled_buffers(features.flip(0))
    for each in (buffers, turned):
        driver_lanes.apply_drivers(NUMBERS, each)
    assert np.array_equal(buffers.outputs, turned.outputs[:, ::-1])
