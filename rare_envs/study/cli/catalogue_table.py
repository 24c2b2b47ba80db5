"""Tables of the names that the command line takes: all names on one screen, or what each name of a kind means."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from rare_envs.plugins import did_you_mean
from rare_envs.study.errors import BadInput

TITLES = {
    "methods": "Methods",
    "egos": "Egos",
    "drivers": "Drivers around the ego (their weights and noise become parameters)",
    "measures": "Safety measures",
}
"""Kinds of names that have one line each, and the titles of their tables."""
EVERYTHING = "all"
KINDS = ("environments", *TITLES, "weather", EVERYTHING)
"""What can be shown in detail, beside one environment."""


def print_overview(entries: dict[str, Any]) -> None:
    """Print all names that `list_names` returns, without their meanings: a screen of 80 columns and 24 lines."""
    console = Console(highlight=False, markup=False)
    environments = Table.grid(padding=(0, 1))
    environments.add_row(Text("environments", style="bold"), Text("parameters", style="bold"))
    for env_id, environment in entries["environments"].items():
        own = [each["name"] for each in environment["parameters"]]
        added = [each["name"] for each in environment["of_learned_drivers"]] if environment["drivers"] else []
        environments.add_row(f"  {env_id}", ", ".join(own + added))
    console.print(environments)
    kinds = {"of HighwayEnv": entries["highway_env"], **{kind: entries[kind] for kind in TITLES}}
    names = Table.grid(padding=(0, 1))
    for kind, known in {**kinds, "weather": [each["name"] for each in entries["weather"]]}.items():
        names.add_row(Text(kind, style="bold"), ", ".join(known))
    console.print(names)
    console.print(
        "What they mean: rare-envs list egos (or another kind, an environment, all).\n"
        "Base distributions: rare-envs bases cut_in."
    )


def print_details(entries: dict[str, Any], what: str) -> None:
    """Print the names of one kind with their meanings.

    Args:
        entries: What `list_names` returns.
        what: One of `KINDS`, or the id of an environment.
    """
    console, whole = Console(highlight=False), what == EVERYTHING
    environments = entries["environments"]
    for env_id, environment in environments.items():
        if whole or what in ("environments", env_id):
            _print_environment(console, env_id, environment)
    if whole or what == "environments":
        console.print(
            "HighwayEnv's own, for estimate, and with its settings for rare_envs.highway_env_problem in Python: "
            f"{', '.join(entries['highway_env'])}\n"
        )
    if whole or what == "weather":
        console.print(_make_parameter_table("Weather, which --weather adds for egos with a camera", entries["weather"]))
    for kind, title in TITLES.items():
        if whole or what == kind:
            console.print(_make_meaning_table(title, entries[kind]))


def choose_entries(entries: dict[str, Any], what: str) -> dict[str, Any]:
    """Return the part of the names that `print_details` prints, under the keys that it has in the whole.

    Args:
        entries: What `list_names` returns.
        what: One of `KINDS`, or the id of an environment.
    """
    if what == EVERYTHING:
        return entries
    if what not in KINDS:
        return {"environments": {what: entries["environments"][what]}}
    kinds = ("environments", "highway_env") if what == "environments" else (what,)
    return {kind: entries[kind] for kind in kinds}


def check_kind(entries: dict[str, Any], what: str) -> str:
    """Return what to show in detail: a kind, or the id that an id or its part behind the slash means.

    Raises:
        BadInput: There is no such kind or environment.
    """
    known: dict[str, str] = {name: name for name in (*KINDS, *entries["environments"])}
    known |= {name.partition("/")[2]: name for name in entries["environments"]}
    if what not in known:
        kinds = ", ".join(KINDS)
        raise BadInput(f"Expected {kinds} or an environment, got {what!r}{did_you_mean(what, known)}.")
    return known[what]


def _print_environment(console: Console, env_id: str, environment: dict[str, Any]) -> None:
    """Print the parameters of an environment, and what else can be chosen there."""
    console.print(_make_parameter_table(env_id, environment["parameters"]))
    console.print(f"  vehicles, each of which can be an agent: {', '.join(environment['vehicles'])}")
    console.print(f"  base distributions: {', '.join(environment['bases'])}, or your own JSON file")
    around = environment["drivers"] or "a script, unless told otherwise"
    console.print(f"  drivers around the ego: {around}")
    added = ", ".join(f"{each['name']} ({each['size']:,} values)" for each in environment["of_learned_drivers"])
    console.print(f"  learned drivers add{', those above too' if environment['drivers'] else ''}: {added}")
    console.print(f"  with HighwayEnv's observations and actions: {environment['kinematics_id']}\n")


def _make_parameter_table(title: str, parameters: list[dict[str, Any]]) -> Table:
    """Return a table of names, units, ranges and meanings."""
    table = Table("parameter", "unit", "range", "meaning", title=title, title_justify="left", title_style="bold")
    for each in parameters:
        name = each["name"] if each["size"] == 1 else f"{each['name']} ({each['size']} values)"
        table.add_row(name, each["unit"], f"{each['low']:g} to {each['high']:g}", each["meaning"])
    return table


def _make_meaning_table(title: str, meanings: dict[str, str]) -> Table:
    """Return a table of names and what each is."""
    table = Table("name", "what it is", title=title, title_justify="left", title_style="bold")
    for name, text in meanings.items():
        table.add_row(name, text)
    return table
