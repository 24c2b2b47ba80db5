"""Recorded rollouts: operations of torch that are recorded once and played with other x, with the same bits of f.

A rollout is some thousands of small operations. On a GPU (`RecordedRollouts`) those of a whole rollout are one CUDA
graph: to start each from Python takes five to ten times as long as the GPU takes for all of them, at 1,024 rollouts.
On the CPU (`RecordedTicks`) those of a tick are a function of NumPy arrays: to start an operation of torch takes longer
than to compute it for some hundreds of rows, and NumPy starts one in a third of the time.
"""

from rare_envs.simulation.recorded.recordability import says_recordable
from rare_envs.simulation.recorded.recorded_ticks import RecordedTicks
from rare_envs.simulation.recorded.rollouts import RecordedRollouts

__all__ = ["RecordedRollouts", "RecordedTicks", "says_recordable"]
