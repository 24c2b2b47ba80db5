"""Markov chains: kernels that leave a conditioned distribution invariant, and the chains that they move."""

from samplers.mcmc.kernels import FixedMetropolis, Kernel, ScaledKernel

__all__ = ["FixedMetropolis", "Kernel", "ScaledKernel"]
