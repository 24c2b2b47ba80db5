"""Policies of Stable-Baselines3, read part by part."""

from rare_envs.egos.sb3.dense_networks import RenamedPolicy, read_dense_policy

__all__ = ["RenamedPolicy", "read_dense_policy"]
