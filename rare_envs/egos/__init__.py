"""Egos: what they need, policies as drivers, their inference in batches, their wrappers and their faults.

Nothing is imported here: a server of an ego needs `rare_envs.plugins` only, without torch.
"""
