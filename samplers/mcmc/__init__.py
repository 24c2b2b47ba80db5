"""Markov chains: kernels that leave a conditioned distribution invariant, and the chains they drive."""
