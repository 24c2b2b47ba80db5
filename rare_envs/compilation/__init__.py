"""Compilation by numba of functions that make no arrays; importing it needs numba."""

from rare_envs.compilation.machine_code import compiled, compiled_fused, single, whole

__all__ = ["compiled", "compiled_fused", "single", "whole"]
