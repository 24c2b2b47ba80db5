"""Compiled rollouts: a fast path beside the torch simulation, for scripted scenarios with the IDM or a policy as ego.

`find_compiled_rollout` says whether a world and its driver have one; the torch simulation remains the reference, and
tests compare the two. Data flow: x to f, in one call. Modules but `selection` and `dense_policy`
need numba, and are imported when a rollout is found.
"""

from rare_envs.simulation.compiled.dense_policy import DensePolicy
from rare_envs.simulation.compiled.selection import CompiledRollout, find_compiled_rollout

__all__ = ["CompiledRollout", "DensePolicy", "find_compiled_rollout"]
