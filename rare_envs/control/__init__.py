"""Control: actions of policies, HighwayEnv's meta-actions and steering, and the Intelligent Driver Model."""

from rare_envs.control.actions import (
    ACTIONS,
    DISCRETE_ACTIONS,
    MAX_ACCELERATION,
    MAX_STEERING,
    META_ACTIONS,
    action_space,
)
from rare_envs.control.idm import IDM, lane_keeping

__all__ = [
    "ACTIONS",
    "DISCRETE_ACTIONS",
    "IDM",
    "MAX_ACCELERATION",
    "MAX_STEERING",
    "META_ACTIONS",
    "action_space",
    "lane_keeping",
]
