"""Listing: the names that the command line takes, what each means, and the traffic models of a scenario."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

import samplers
from agents.learned.networks import HEAD_SIZE
from rare_envs.distributions.events import describe_checks, describe_motion
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.space import Parameter
from rare_envs.exposure import explain_no_frequency, read_source
from rare_envs.measures.base import Measure, TraceMeasure
from rare_envs.measures.registry import MEASURES
from rare_envs.plugins import did_you_mean
from rare_envs.scenarios.base import Scenario, load_base
from rare_envs.scenarios.registry import (
    HIGHWAY_ENV_IDS,
    SCENARIOS,
    complete_id,
    find_scenario,
    kinematics_id,
    split_layout,
)
from rare_envs.sensors.camera import CONDITIONS, SENSOR_NOISE
from rare_envs.simulation.background import noise_size
from rare_envs.study.arguments import BadInput
from rare_envs.study.text import CleanConsole, format_rate
from samplers.output import MOST_LINES, fold_rows

TICK = 0.1
"""[s], the usual one."""
EGOS = {
    "idm": "rule-based driver, Intelligent Driver Model (the default); with other parameters: idm?time_headway=2",
    "human": "attentive human driver by a published model with reaction time, errors and glances, docs/human_driver.md",
    "human:no-headway-rule": "the same, whose glances may be longer than the headway; look at both",
    "cc_human": "reference driver: competent and careful human driver of UN Regulation 157",
    "alks": "reference driver: automated lane keeping system of UN Regulation 157",
    "fsm": "reference driver: the JRC's fuzzy safety model",
    "rss": "reference driver: responsibility-sensitive safety, with the JRC's parameters",
    "imitation": "shipped ego with lidar, learned from recorded traffic and from encounters",
    "mgail, gail, FILE.safetensors": "learned driver with lidar, by mean actions",
    "vision": "PilotNet on pictures of a front camera, which imitates a driver by rule; see docs/camera.md",
    "FILE.zip": "policy saved by Stable-Baselines3 or sb3-contrib, VecNormalize statistics beside it included",
    "hf:USER/REPOSITORY": "such a policy of the Hugging Face Hub, from its cache on this machine or downloaded",
    "FILE.onnx": "graph from observations to actions; rare-envs export EGO.zip EGO.onnx writes one",
    "module:function": "what your function returns: any object with Stable-Baselines3's predict",
    "tcp://HOST:PORT": "program in any language, see docs/egos.md; python -m agents.remote serves one of these",
    "process:EGO": "one of these in a process of its own, for an ego that may hang or die",
    "noisy:EGO": "one of these behind the imperfections of a full stack, see docs/egos.md",
}
DRIVERS = {
    "mgail": "learned from recorded traffic by imitation, with rules of collision avoidance and lane changes",
    "mgail?rules=0": "its network alone, with the noise of recorded driving (the highway's default)",
    "gail": "a network learned by policy gradients, without rules",
    "idm": "rule-based driver, Intelligent Driver Model and lane keeping by what it sees",
    "idm+mobil": "the same, which changes lanes too, by MOBIL",
    "FILE.safetensors": "driver that you trained by python -m training.imitation",
}
TITLES = {
    "methods": "Methods",
    "egos": "Egos",
    "drivers": "Drivers around the ego (their weights and noise become parameters)",
    "measures": "Safety measures",
}
"""Kinds of names that have one line each, and the titles of their tables."""
EVERYTHING = "all"
KINDS = ("environments", "bases", *TITLES, "weather", EVERYTHING)
"""What can be shown in detail, beside one environment."""


def list_names() -> dict[str, Any]:
    """Return everything that can be named on the command line, as JSON-ready values."""
    measures = {name: each.of if isinstance(each, Measure | TraceMeasure) else each for name, each in MEASURES.items()}
    return {
        "environments": {env_id: _describe_environment(env_id, scenario) for env_id, scenario in SCENARIOS.items()},
        "highway_env": list(HIGHWAY_ENV_IDS),
        "weather": [_describe(parameter) for parameter in (*CONDITIONS, SENSOR_NOISE)],
        "methods": {name: _first_line(method) for name, method in samplers.methods.METHODS.items()},
        "egos": EGOS,
        "drivers": DRIVERS,
        "measures": {name: _first_line(measure) for name, measure in measures.items()},
    }


def _describe_environment(env_id: str, scenario: Scenario) -> dict[str, Any]:
    """Return what a scenario has, JSON-ready."""
    n_noise = noise_size(round(scenario.horizon / TICK), scenario.vehicles - 1)
    return {
        "kinematics_id": kinematics_id(env_id),
        "parameters": [_describe(parameter) for parameter in scenario.parameters],
        "vehicles": list(scenario.vehicle_names),
        "bases": list(scenario.bases),
        "drivers": scenario.drivers,
        "of_learned_drivers": [{"name": "weights", "size": HEAD_SIZE}, {"name": "noise", "size": n_noise}],
    }


def _describe(parameter: Parameter) -> dict[str, Any]:
    """Return a parameter as JSON-ready values; None for an end of its range that there is not."""
    values = asdict(parameter)
    return values | {end: values[end] if math.isfinite(values[end]) else None for end in ("low", "high")}


def _first_line(documented: object) -> str:
    """Return the first line of a docstring, as a noun: "Return the gap ..." becomes "Gap ..."."""
    line = (documented.__doc__ or "").strip().partition("\n")[0].removeprefix("Return ").removeprefix("the ")
    return line[:1].upper() + line[1:]


def print_overview(entries: dict[str, Any]) -> None:
    """Print all names that `list_names` returns, without their meanings: a screen of 80 columns and 24 lines."""
    console = CleanConsole(highlight=False, markup=False)
    environments = {"environments": "parameters"}
    for env_id, environment in entries["environments"].items():
        added = environment["of_learned_drivers"] if environment["drivers"] else []
        environments[f"  {env_id}"] = ", ".join(each["name"] for each in environment["parameters"] + added)
    weather = [each["name"] for each in entries["weather"]]
    kinds = {"of HighwayEnv": entries["highway_env"], **{kind: entries[kind] for kind in TITLES}, "weather": weather}
    for rows, bold in ((environments, 1), ({kind: ", ".join(known) for kind, known in kinds.items()}, len(kinds))):
        table = Table.grid(padding=(0, 1))
        for number, (name, text) in enumerate(rows.items()):
            style = "bold" if number < bold else ""
            table.add_row(Text(name, style=style), Text(text, style=style if rows is environments else ""))
        console.print(table)
    console.print(
        "What they mean: rare-envs list egos (or another kind, or all).\n"
        "Traffic models: rare-envs list CutIn (of one scenario) or rare-envs list bases."
    )


def choose_entries(entries: dict[str, Any], what: str) -> dict[str, Any]:
    """Return the part of the names that a kind or a scenario means, a scenario and "bases" with traffic models."""
    if what == EVERYTHING:
        return entries
    if what == "bases":
        return {"bases": {env_id: list_bases(scenario) for env_id, scenario in SCENARIOS.items()}}
    if what in KINDS:
        return {kind: entries[kind] for kind in ((what, "highway_env") if what == "environments" else (what,))}
    env_id = split_layout(complete_id(what))[0]
    if env_id not in SCENARIOS and ":" not in env_id:
        hint = did_you_mean(what, [*KINDS, *SCENARIOS, *(each.name for each in SCENARIOS.values())])
        raise BadInput(f"Expected {', '.join(KINDS)} or a scenario, such as CutIn, got {what!r}{hint}.")
    scenario, own = find_scenario(env_id), env_id.rpartition(":")[2]
    return {"environments": {own: _describe_environment(own, scenario)}, "bases": {own: list_bases(scenario)}}


def print_details(chosen: dict[str, Any]) -> None:
    """Print names that `choose_entries` returns with their meanings."""
    console = CleanConsole(highlight=False, markup=False)
    for env_id, environment in chosen.get("environments", {}).items():
        _print_parameters(console, env_id, environment["parameters"])
        added = ", ".join(f"{each['name']} ({each['size']:,} values)" for each in environment["of_learned_drivers"])
        for text in (
            f"vehicles, each of which can be an agent: {', '.join(environment['vehicles'])}",
            f"traffic models (--base): {', '.join(environment['bases'])}, or your own JSON file",
            f"drivers around the ego (--drivers): {environment['drivers'] or 'a script by default'}",
            f"learned drivers add{', those above too' if environment['drivers'] else ''}: {added}",
            f"with HighwayEnv's observations and actions: {environment['kinematics_id']}\n",
        ):
            console.print(f"  {text}")
    unbroken = CleanConsole(highlight=False, soft_wrap=True, markup=False)
    for env_id, bases in chosen.get("bases", {}).items():
        unbroken.print(f"Traffic models of {env_id}", style="bold")
        for number, (name, base) in enumerate(bases.items()):
            unbroken.print(f"{name}{' (default)' if number == 0 else ''}", style="bold")
            facts = [(f"  {title}", text) for title, text in _summarise(base).items() if text]
            unbroken.print("\n".join(fold_rows(facts, len(facts) * MOST_LINES)))
        unbroken.print()
    if "highway_env" in chosen:
        own = "HighwayEnv's own, for estimate, and with its settings for rare_envs.highway_env_problem in Python: "
        console.print(f"{own}{', '.join(chosen['highway_env'])}\n")
    if "weather" in chosen:
        title = "Weather for egos with a camera (weather: true in a file for --config)"
        _print_parameters(console, title, chosen["weather"])
    for kind in (kind for kind in TITLES if kind in chosen):
        _print_table(console, TITLES[kind], ["name", "what it is"], chosen[kind].items())


def _print_parameters(console: Console, title: str, parameters: list[dict[str, Any]]) -> None:
    """Print a table of names, units, ranges and meanings."""
    rows = []
    for each in parameters:
        name = each["name"] if each["size"] == 1 else f"{each['name']} ({each['size']} values)"
        ends = "any" if each["low"] is None else f"{each['low']:g} to {each['high']:g}"
        rows.append((name, each["unit"], ends, each["meaning"]))
    _print_table(console, title, ["parameter", "unit", "range", "meaning"], rows)


def _print_table(console: Console, title: str, heads: list[str], rows: Iterable[tuple[str, ...]]) -> None:
    table = Table(*heads, title=title, title_justify="left", title_style="bold")
    for row in rows:
        table.add_row(*row)
    console.print(table)


def list_bases(scenario: Scenario) -> dict[str, dict[str, Any]]:
    """Return the traffic models of a scenario by name, the default first; None and empty where nothing is known."""
    return {name: _describe_base(scenario, name) for name in scenario.bases}


def _describe_base(scenario: Scenario, name: str) -> dict[str, Any]:
    """Return what is known of a traffic model, JSON-ready."""
    base, file = load_base(scenario, name), scenario.bases[name]
    content = json.loads(file.read_text(encoding="utf-8")) if hasattr(file, "read_text") else file
    record = content.get("provenance") if isinstance(content, Mapping) else None
    record = record if isinstance(record, Mapping) else {}
    known: dict[str, Any] = {
        "kind": record.get("kind"),
        **{key: text or None for key, text in read_source(record).items()},
        **{key: record.get(key) for key in ("coordinates", "bic", "held_out_log_prob", "checked_against")},
        **dict.fromkeys(("fitted_to", "events", "family", "frequency")),
        "refits": 0,
        "no_frequency": explain_no_frequency(record),
        "checks": record.get("checks", []),
        "motion": record.get("motion", {}),
    }
    if isinstance(base, FittedDistribution):
        checks = [{key: getattr(check, key) for key in ("name", "recorded", "expected")} for check in base.checks]
        known |= {"fitted_to": base.fitted_to, "events": asdict(base.events), "family": base.family}
        known |= {"refits": len(base.refits), "checks": checks}
        if (counted := base.frequency) is not None:
            rates = {"per_hour": counted.per_hour, "per_km": counted.per_km}
            known |= {"frequency": {**asdict(counted), **rates}, "no_frequency": None}
    return known


def _summarise(base: Mapping[str, Any]) -> dict[str, str]:
    """Return titles and texts of the lines of one base; empty texts where nothing is known."""
    fit = {"BIC {:,.1f}": base["bic"], "held-out log likelihood {:.2f} per event": base["held_out_log_prob"]}
    family, coordinates = base["family"] or "", base["coordinates"] or ""
    told = all(part.rpartition(": ")[2] in family for part in coordinates.split("; "))  # of strata each by itself
    checks = describe_checks(base["checks"])
    against = f" ({base['checked_against']})" if base["checked_against"] else ""
    counted, known = f"not known, no rate per hour or km: {base['no_frequency']}", base["frequency"]
    if known is not None:
        counted = f"{format_rate(known['per_hour'])} per hour, {format_rate(known['per_km'])} per km: "
        counted += f"{known['count']:,} in {known['hours']:g} h ({known['definition']})"
    return {
        "fitted to": f"{base['fitted_to']}, {base['refits'] or 'no'} refits" if base["fitted_to"] else "",
        "kind": base["kind"] or "",
        "site": ", ".join(filter(None, (base["site"], base["date"]))),
        "data": base["data"] or "",
        "licence": base["licence"] or "",
        "family": family if told else ", ".join(filter(None, (family, coordinates))),
        "fit": ", ".join(text.format(value) for text, value in fit.items() if value is not None),
        "frequency": counted,
        "counted in": (known or {}).get("source", ""),
        "checks": f"recorded / expected: {checks}{against}" if checks else "",
        **{who: describe_motion(found) for who, found in base["motion"].items()},
    }
