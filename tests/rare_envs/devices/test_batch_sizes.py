import pytest
import torch

import rare_envs
from rare_envs.devices.batch_sizes import (
    CAMERA_TILE,
    GPU_TILES,
    LIDAR_TILE,
    POLICY_CHUNK,
    POLICY_TILE,
    RULE_CHUNK,
    RULE_TILE,
    tile_size,
)


def constant(observation):
    return 0.0


def sizes(**settings):
    problem = rare_envs.DrivingProblem("rare_envs/CutIn-v0", **settings)
    return problem.tile, problem.chunk_size


def test_what_costs_more_memory_is_simulated_in_smaller_tiles():
    assert sizes() == (RULE_TILE, RULE_CHUNK)
    assert sizes(ego=constant) == (POLICY_TILE, POLICY_CHUNK)
    assert sizes(ego=constant, observation="lidar") == (LIDAR_TILE, POLICY_CHUNK)
    assert sizes(ego=constant, observation="camera") == (CAMERA_TILE, CAMERA_TILE)  # a chunk is a tile at most


def test_nobody_looks_at_the_camera_of_a_rule_based_ego():
    assert sizes(observation="camera") == (RULE_TILE, RULE_CHUNK)


def test_a_chunk_may_be_given():
    assert sizes(chunk_size=7) == (RULE_TILE, 7)


@pytest.mark.parametrize(("pictures", "much"), [(False, False), (False, True), (True, False)])
def test_a_gpu_has_more_at_once(pictures, much):
    on_cpu, on_gpu = (
        tile_size(torch.device(name), by_policy=True, takes_pictures=pictures, keeps_much=much)
        for name in ("cpu", "cuda")
    )
    assert on_gpu == GPU_TILES * on_cpu
