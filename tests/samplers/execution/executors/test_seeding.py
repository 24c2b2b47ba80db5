"""A simulation that draws by global generators draws the same for its chunk, and disturbs nobody else's."""

import random
import subprocess
import sys

import numpy as np
import torch

from samplers.execution.executors.seeding import seed_generators


def draw():
    return random.random(), np.random.random(), float(torch.rand(1))  # noqa: NPY002


def test_the_seed_and_the_index_decide():
    seen = []
    for seed, index in ((1, (0,)), (1, (0,)), (1, (1,)), (2, (0,)), (1, (0, 3))):
        with seed_generators(seed, index):
            seen.append(draw())
    assert seen[0] == seen[1]
    assert len(set(seen)) == 4


def test_the_generators_go_on_as_before():
    random.seed(5), np.random.seed(5), torch.manual_seed(5)  # noqa: NPY002
    expected = draw()
    random.seed(5), np.random.seed(5), torch.manual_seed(5)  # noqa: NPY002
    with seed_generators(1, (0,)):
        draw()
    assert draw() == expected


FIRST_IMPORT = """
import sys
from samplers.execution.executors.seeding import SeededWork
n_calls = 0
def work(chunk):
    import torch
    global n_calls
    n_calls += 1
    return float(torch.rand(1))
assert "torch" not in sys.modules
seeded = SeededWork(work, 7)
print(seeded((0,), None) == seeded((0,), None), n_calls)
"""


def test_torch_that_a_chunk_imports_first_is_seeded_all_the_same():
    """Such a chunk is computed once more."""
    done = subprocess.run([sys.executable, "-c", FIRST_IMPORT], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "3"]
