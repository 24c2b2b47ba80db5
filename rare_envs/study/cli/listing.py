"""Listing: the names that the command line takes, what each means, and the base distributions of a scenario."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import gymnasium as gym
from rich.console import Console
from rich.table import Table
from rich.text import Text

import samplers
from agents.learned.networks import HEAD_SIZE
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.exposure.rate import explain_no_frequency, read_source
from rare_envs.measures.base import Measure, TraceMeasure
from rare_envs.measures.registry import MEASURES
from rare_envs.plugins import did_you_mean
from rare_envs.scenarios.base import Scenario
from rare_envs.scenarios.base_distributions import TextFile, load_base
from rare_envs.scenarios.registry import SCENARIOS, env_id_of, find_scenario, kinematics_id
from rare_envs.sensors.camera.context import CONDITIONS, SENSOR_NOISE
from rare_envs.simulation.background import noise_size
from rare_envs.study.errors import BadInput
from rare_envs.study.text import format_rate

TICK = 0.1
"""[s], the usual one."""
EGOS = {
    "idm": "rule-based driver, Intelligent Driver Model (the default); with other parameters: idm?time_headway=2",
    "human": "attentive human driver by a published model with reaction time, errors and glances, docs/human_driver.md",
    "imitation": "shipped ego with lidar, learned from recorded traffic and from encounters",
    "mgail, gail, FILE.safetensors": "learned driver with lidar, by mean actions",
    "vision": "PilotNet on pictures of a front camera, which imitates a driver by rule; see docs/camera.md",
    "FILE.zip": "policy saved by Stable-Baselines3 or sb3-contrib, VecNormalize statistics beside it included",
    "hf:USER/REPOSITORY": "such a policy of the Hugging Face Hub, from its cache on this machine or downloaded",
    "FILE.onnx": "graph from observations to actions; rare-envs export-ego writes one of a .zip",
    "module:function": "what your function returns: any object with Stable-Baselines3's predict",
    "tcp://HOST:PORT": "program in any language, see docs/egos.md; rare-envs serve-ego serves one of these",
    "process:EGO": "one of these in a process of its own, for an ego that may hang or die",
    "noisy:EGO": "one of these behind the imperfections of a full stack, see docs/egos.md",
}
DRIVERS = {
    "mgail": "learned from recorded traffic by imitation, with rules of collision avoidance and lane changes",
    "mgail?rules=0": "its network alone, with the noise of recorded driving (the highway's default)",
    "gail": "a network learned by policy gradients, without rules",
    "idm": "rule-based driver, Intelligent Driver Model and lane keeping by what it sees",
    "idm+mobil": "the same, which changes lanes too, by MOBIL",
    "FILE.safetensors": "driver that you trained, see rare-envs train-drivers",
}


def list_names() -> dict[str, Any]:
    """Return everything that can be named on the command line, as JSON-ready values."""
    import highway_env  # noqa: F401  (registers its ids)

    from rare_envs.interop.scenario import SUPPORTED

    environments = {
        env_id: {
            "kinematics_id": kinematics_id(env_id),
            "parameters": [asdict(parameter) for parameter in scenario.parameters],
            "vehicles": list(scenario.vehicle_names),
            "bases": list(scenario.bases),
            "drivers": scenario.drivers,
            "of_learned_drivers": [
                {"name": "weights", "size": HEAD_SIZE},
                {"name": "noise", "size": noise_size(round(scenario.horizon / TICK), scenario.vehicles - 1)},
            ],
        }
        for env_id, scenario in SCENARIOS.items()
    }
    return {
        "environments": environments,
        "highway_env": [name for name in SUPPORTED if name in gym.registry],
        "weather": [asdict(parameter) for parameter in (*CONDITIONS, SENSOR_NOISE)],
        "methods": {name: _first_line(method) for name, method in samplers.METHODS.items()},
        "egos": EGOS,
        "drivers": DRIVERS,
        "measures": {
            name: _first_line(measure.of if isinstance(measure, Measure | TraceMeasure) else measure)
            for name, measure in MEASURES.items()
        },
    }


def _first_line(documented: object) -> str:
    """Return the first line of a docstring, as a noun: "Return the gap ..." becomes "Gap ..."."""
    line = (documented.__doc__ or "").strip().partition("\n")[0].removeprefix("Return ").removeprefix("the ")
    return line[:1].upper() + line[1:]


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
    """Print the names of one kind with their meanings."""
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
    """Return the part of the names that `print_details` prints, under the keys that it has in the whole."""
    if what == EVERYTHING:
        return entries
    if what not in KINDS:
        return {"environments": {what: entries["environments"][what]}}
    kinds = ("environments", "highway_env") if what == "environments" else (what,)
    return {kind: entries[kind] for kind in kinds}


def check_kind(entries: dict[str, Any], what: str) -> str:
    """Return what to show in detail: a kind, or the id that an id or its part behind the slash means."""
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


def list_bases(scenario: str) -> dict[str, dict[str, Any]]:
    """Return what is known of each base distribution of a scenario, by name, the default first; JSON-ready."""
    found = find_scenario(resolve_scenario(scenario))
    return {name: _describe_base(found, name) for name in found.bases}


def resolve_scenario(scenario: str) -> str:
    """Return the environment id that an id or a short name means; versions have bases of the same names."""
    return scenario if ":" in scenario else env_id_of(scenario)


def print_bases(env_id: str, bases: Mapping[str, Mapping[str, Any]]) -> None:
    """Print what `list_bases` returns for an environment, a few lines each."""
    console = Console(highlight=False, soft_wrap=True, markup=False)
    console.print(f"base distributions of {env_id}")
    for number, (name, base) in enumerate(bases.items()):
        console.print(f"{name}{'   (the default)' if number == 0 else ''}", style="bold")
        for title, text in _summarise(base).items():
            if text:
                console.print(f"  {title:<22} {text}")


def _describe_base(scenario: Scenario, name: str) -> dict[str, Any]:
    base, record = load_base(scenario, name), _read_record(scenario, name)
    known: dict[str, Any] = {
        "kind": record.get("kind"),
        **{key: text or None for key, text in read_source(record).items()},
        "coordinates": record.get("coordinates"),
        "bic": record.get("bic"),
        "held_out_log_prob": record.get("held_out_log_prob"),
        "fitted_to": None,
        "events": None,
        "family": None,
        "refits": 0,
        "frequency": None,
        "no_frequency": explain_no_frequency(record),
        "checks": record.get("checks", []),
        "checked_against": record.get("checked_against"),
    }
    if not isinstance(base, FittedDistribution):
        return known
    frequency = base.frequency
    return {
        **known,
        "no_frequency": known["no_frequency"] if frequency is None else None,
        "fitted_to": base.fitted_to,
        "events": base.events.to_dict(),
        "family": base.family,
        "refits": len(base.refits),
        "frequency": frequency and {**frequency.to_dict(), "per_hour": frequency.per_hour, "per_km": frequency.per_km},
        "checks": [
            {"name": check.name, "recorded": check.recorded, "expected": check.expected} for check in base.checks
        ],
    }


def _read_record(scenario: Scenario, name: str) -> Mapping[str, Any]:
    """Return the provenance of a base distribution; empty where it has none."""
    base = scenario.bases[name]
    content = json.loads(base.read_text(encoding="utf-8")) if isinstance(base, TextFile) else base
    record = content.get("provenance") if isinstance(content, Mapping) else None
    return record if isinstance(record, Mapping) else {}


def _summarise(base: Mapping[str, Any]) -> dict[str, str]:
    """Return titles and texts of the lines of one base; empty texts where nothing is known."""
    site = ", ".join(text for text in (base["site"], base["date"]) if text)
    fit = [
        f"BIC {base['bic']:,.1f}" if base["bic"] is not None else "",
        f"held-out log likelihood {base['held_out_log_prob']:.2f} per event"
        if base["held_out_log_prob"] is not None
        else "",
    ]
    against = f" ({base['checked_against']})" if base["checked_against"] else ""
    checks = [f"{each['name']} {each['recorded']} / {each['expected']:.3g}" for each in base["checks"]]
    return {
        "fitted to": f"{base['fitted_to']}, {base['refits'] or 'no'} refits" if base["fitted_to"] else "",
        "kind": base["kind"] or "",
        "site": site,
        "data": base["data"] or "",
        "licence": base["licence"] or "",
        "family": _join_family(base["family"] or "", base["coordinates"] or ""),
        "fit": ", ".join(text for text in fit if text),
        "frequency": _describe_frequency(base["frequency"], base["no_frequency"]),
        "counted in": (base["frequency"] or {}).get("source", ""),
        "recorded / expected": ", ".join(checks) + against,
    }


def _describe_frequency(frequency: Mapping[str, Any] | None, reason: str) -> str:
    if frequency is None:
        return f"not known, no rate per hour or km: {reason}"
    return (
        f"{format_rate(frequency['per_hour'])} per hour, {format_rate(frequency['per_km'])} per km: "
        f"{frequency['count']:,} in {frequency['hours']:g} h ({frequency['definition']})"
    )


def _join_family(family: str, coordinates: str) -> str:
    """Return the family in words with its coordinates, which it may name already."""
    return family if coordinates in family else ", ".join(text for text in (family, coordinates) if text)
