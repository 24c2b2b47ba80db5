"""The methods: Monte Carlo, importance sampling, cross-entropy, subset simulation, two-stage."""
