"""Several agents: their episode, its step and their rewards."""

from rare_envs.multi_agent.rewards import AdversaryTerms, Transition, adversary_reward, own_reward
from rare_envs.multi_agent.step import play

__all__ = ["AdversaryTerms", "Transition", "adversary_reward", "own_reward", "play"]
