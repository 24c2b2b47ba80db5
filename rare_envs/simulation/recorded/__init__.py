"""Recorded rollouts: on a GPU, the operations of a whole rollout as one CUDA graph, which is started at once.

A rollout is some thousands of small operations. To start each from Python takes five to ten times as long as the GPU
takes for all of them, at 1,024 rollouts. What is recorded is what torch does: f has the same bits.
"""

from rare_envs.simulation.recorded.recordability import says_recordable
from rare_envs.simulation.recorded.rollouts import RecordedRollouts

__all__ = ["RecordedRollouts", "says_recordable"]
