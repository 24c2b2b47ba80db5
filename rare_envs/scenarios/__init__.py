"""Scenarios: what x means and how the vehicles around the ego move."""

from rare_envs.scenarios.registry import SCENARIOS, scenario_named

__all__ = ["SCENARIOS", "scenario_named"]
