"""Driving environments whose scenarios are points x with a probability: how often does a policy crash?"""

from rare_envs.startup import end_at_signals, find_missing_libraries, is_command_line, require_libraries

end_at_signals()  # before what takes long to import

from typing import TYPE_CHECKING, Any

from rare_envs.plugins import make_lazy_getattr
from rare_envs.scenarios.registry import SCENARIOS
from rare_envs.startup import __version__ as __version__

if not is_command_line() or not find_missing_libraries():  # a command line shows its help without them
    require_libraries()  # before anything that needs them

    from rare_envs.registration import (
        parallel_env,
        register_envs,
        register_scenario,
    )

    register_envs()

if TYPE_CHECKING:
    from rare_envs.control.idm import IDM
    from rare_envs.distributions.space import ScenarioSpace
    from rare_envs.interop import HighwayEnvScenario, highway_env_problem
    from rare_envs.problem import DrivingProblem
    from rare_envs.study.risk import risk
    from rare_envs.study.run_folder import load_study

    ENV_IDS: tuple[str, ...]
    """Ids of all environments, your own included."""

__all__ = [
    "ENV_IDS",
    "IDM",
    "DrivingProblem",
    "HighwayEnvScenario",
    "ScenarioSpace",
    "highway_env_problem",
    "load_study",
    "parallel_env",
    "register_scenario",
    "risk",
]
_LAZY = {
    "DrivingProblem": "rare_envs.problem",
    "IDM": "rare_envs.control.idm",
    "HighwayEnvScenario": "rare_envs.interop",
    "ScenarioSpace": "rare_envs.distributions.space",
    "highway_env_problem": "rare_envs.interop",
    "load_study": "rare_envs.study.run_folder",
    "risk": "rare_envs.study.risk",
}

_import_lazily = make_lazy_getattr(__name__, _LAZY)


def __getattr__(name: str) -> Any:
    """Import torch only when a name that needs it is used; list the environments as they are now."""
    return tuple(SCENARIOS) if name == "ENV_IDS" else _import_lazily(name)


def __dir__() -> list[str]:
    """Return the public names, used already or not."""
    return __all__
