"""Recorded rollouts: on a GPU, the operations of a whole rollout as one CUDA graph, which is started at once.

A rollout is some thousands of small operations. To start each from Python takes five to seven times as long as the GPU
takes for all of them, with up to 100,000 rollouts at once. What is recorded is what torch does: f has the same bits.
"""

from rare_envs.simulation.recorded.rollouts import RecordedRollouts

__all__ = ["RecordedRollouts"]
