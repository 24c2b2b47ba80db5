"""Scenarios: what x means and how the vehicles around the ego move. One file each, and one line here."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rare_envs.scenarios.base import Scenario


class Registry(Mapping[str, "Scenario"]):
    """Environment ids to scenarios; a file is imported, and torch with it, when its scenario is first asked for."""

    def __init__(self, entries: Mapping[str, str]) -> None:
        """From ids to "module:name"."""
        self._entries: dict[str, str | Scenario] = dict(entries)

    def __getitem__(self, env_id: str) -> Scenario:
        """The scenario of an id."""
        entry = self._entries[env_id]
        if isinstance(entry, str):
            module, _, name = entry.partition(":")
            entry = self._entries[env_id] = getattr(import_module(module), name)
        return entry

    def __iter__(self) -> Iterator[str]:
        """The ids in the order of their registration."""
        return iter(self._entries)

    def __len__(self) -> int:
        """How many there are."""
        return len(self._entries)

    def add(self, env_id: str, scenario: Scenario) -> None:
        """Add a scenario, or replace one."""
        self._entries[env_id] = scenario

    def remove(self, env_id: str) -> None:
        """Forget a scenario."""
        del self._entries[env_id]


SCENARIOS = Registry(
    {
        "rare_envs/CarFollowing-v0": "rare_envs.scenarios.car_following:CAR_FOLLOWING",
        "rare_envs/CutIn-v0": "rare_envs.scenarios.cut_in:CUT_IN",
        "rare_envs/Highway-v0": "rare_envs.scenarios.highway:HIGHWAY",
        "rare_envs/HardBrake-v0": "rare_envs.scenarios.hard_brake:HARD_BRAKE",
    }
)


def named(name: str) -> Scenario:
    """The scenario of a short name, such as "cut_in".

    Raises:
        ValueError: If there is none.
    """
    for scenario in SCENARIOS.values():
        if scenario.name == name:
            return scenario
    raise ValueError(f"Unknown scenario {name!r}; there are {', '.join(each.name for each in SCENARIOS.values())}.")
