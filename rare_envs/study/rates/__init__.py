"""Rates of collisions over several scenarios: `rare_envs.risk`, its table and its picture."""
