"""Egos and drivers: the policies whose safety is estimated, and those that surround them."""

from rare_envs.startup import require_libraries

require_libraries()  # before anything that needs them

from agents.files import Provenance, read_provenance
from agents.learned.driver import LearnedDriver, LearnedEgo, read_driver, save_driver
from agents.loading import Ego, load_driver, load_ego
from agents.saved_ego import SavedEgo

__all__ = [
    "Ego",
    "LearnedDriver",
    "LearnedEgo",
    "Provenance",
    "SavedEgo",
    "load_driver",
    "load_ego",
    "read_driver",
    "read_provenance",
    "save_driver",
]


def __dir__() -> list[str]:
    """Return the public names, used already or not."""
    return __all__
