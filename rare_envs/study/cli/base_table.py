"""Base distributions of a scenario: what each was fitted to, how well it fits, how often its events happen."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from rich.console import Console

from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.exposure.base_record import explain_no_frequency, read_source
from rare_envs.scenarios.base import Scenario
from rare_envs.scenarios.base_distributions import TextFile, load_base
from rare_envs.scenarios.registry import env_id_of, find_scenario
from rare_envs.study.rates.text import format_rate


def list_bases(scenario: str) -> dict[str, dict[str, Any]]:
    """Return what is known of each base distribution of a scenario, by name, the default first; JSON-ready.

    Args:
        scenario: Environment id or short name.

    Raises:
        ValueError: There is no such scenario, or a base cannot be read.
    """
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
