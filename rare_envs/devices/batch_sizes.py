"""Batch sizes: how many rollouts torch simulates at once, and a worker makes at once."""

import torch

RULE_TILE = 16384
"""Rollouts that a rule-based ego drives at once: the number at which eager torch is fastest."""
POLICY_TILE = 4096
"""Likewise with a policy; fixed, because matrix products round differently by batch size."""
LIDAR_TILE = 512
"""Likewise with lidar, or a measure that keeps whole episodes: small enough for all of it to stay in the cache."""
CAMERA_TILE = 128
"""Likewise with a policy that takes pictures: its layers' values for all of them have to fit into memory."""

GPU_TILES = 16
"""Times as many rollouts at once on a GPU, which takes about as long for few as for thousands."""

RULE_CHUNK = 4096
"""Rollouts of a rule-based ego that a worker makes at once: enough for torch, and some for each of several workers."""
POLICY_CHUNK = 256
"""Likewise with a policy, which is slower."""


def tile_size(device: torch.device, *, by_policy: bool, takes_pictures: bool, keeps_much: bool) -> int:
    """Return the number of rollouts that torch simulates at once.

    Args:
        device: Where torch simulates.
        by_policy: Whether the ego is a policy.
        takes_pictures: Whether this takes pictures.
        keeps_much: Whether there is lidar, or a measure that keeps whole episodes.

    Example:
        >>> tile_size(torch.device("cpu"), by_policy=False, takes_pictures=False, keeps_much=False)
        16384
    """
    factor = 1 if device.type == "cpu" else GPU_TILES
    if takes_pictures:
        return factor * CAMERA_TILE
    if keeps_much:
        return factor * LIDAR_TILE
    return factor * (POLICY_TILE if by_policy else RULE_TILE)


def chunk_size(tile: int, *, by_policy: bool) -> int:
    """Return the number of rollouts that a worker makes at once, a tile at most.

    Example:
        >>> chunk_size(128, by_policy=True), chunk_size(4096, by_policy=True)
        (128, 256)
    """
    return min(tile, POLICY_CHUNK if by_policy else RULE_CHUNK)
