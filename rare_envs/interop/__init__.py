"""HighwayEnv's own environments as scenarios: parameters, a traffic model, a problem for samplers."""

from rare_envs.interop.problem import HighwayEnvProblem, highway_env_problem
from rare_envs.interop.scenario import HighwayEnvScenario

__all__ = ["HighwayEnvProblem", "HighwayEnvScenario", "highway_env_problem"]
