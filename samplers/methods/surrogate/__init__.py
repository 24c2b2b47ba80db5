"""Surrogate: kriging of f learns where it fails, and importance sampling on the simulator gives the estimate.

`method` has the class, `kriging` the regression of f, `learning` the points that it is learned from, `pool` the draws
that both are chosen from, `estimate` what those for the estimate say, `settings` the numbers.
"""
