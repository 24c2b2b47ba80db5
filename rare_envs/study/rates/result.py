"""Result of a risk: each scenario's rate, their sum, and the table for people."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.exposure import HUMAN_BENCHMARKS, CollisionRate, TotalRate, describe_human_contacts
from rare_envs.exposure.rate import MILLION_KM
from rare_envs.study.rates.plots import save_risk_plot
from rare_envs.study.rates.text import (
    describe_injuries,
    describe_uncertainty,
    format_rate,
    format_share,
    format_with_interval,
    name_scenario,
)
from rare_envs.study.report import Report
from rare_envs.version import __version__


@dataclass(frozen=True, eq=False, kw_only=True)
class ScenarioRisk:
    """One scenario of a risk."""

    report: Report
    """Its evaluation."""
    rate: CollisionRate
    """Its collisions per hour and per km."""
    site_factors: Mapping[str, float]
    """Rates under the bases of other sites over that under its own, by name, as far as they are known."""
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the scenario."""
        return self.rate.scenario

    @property
    def base_name(self) -> str:
        """Name or file of the base distribution."""
        return self.report.study.base_name

    @property
    def events(self) -> int | None:
        """Recorded events behind the base distribution, of its first part; None where nobody says."""
        base = self.report.study.base
        return base.events.used[0] if isinstance(base, FittedDistribution) else None

    @property
    def kinds(self) -> dict[str, float]:
        """Collisions per million km by kind of crash; empty where it is not known."""
        scale = self.rate.frequency.per_km * MILLION_KM
        return {kind: scale * share.p for kind, share in self.report.kinds.shares.items()}

    def describe(self) -> str:
        """Return the line of the table: frequency x p = rate, its interval, and the events behind it."""
        rate, base = self.rate, self.report.study.base
        behind = base.fitted_to if isinstance(base, FittedDistribution) else "events not known"
        version = self.report.study.question.env_id.rpartition("/")[2]  # whose bases may have the same names
        factors = {name: factor for name, factor in self.site_factors.items() if factor > 0}
        sites = "".join(f", under {name} {factor:.2g} times as much" for name, factor in factors.items())
        return (
            f"{name_scenario(self.name):<13} {format_rate(rate.frequency.per_km)} per km x {rate.probability.p:.1e} = "
            f"{format_with_interval(rate.per_million_km, rate.interval_per_million_km, ' ')}   "
            f"{behind} ({self.base_name} of {version}){sites}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            **self.rate.to_dict(),
            "base": self.base_name,
            "events": self.events,
            "site_factors": dict(self.site_factors),
            "kinds_per_million_km": self.kinds,
            "notes": list(self.notes),
            "report": self.report.to_dict(),
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class Risk:
    """Collisions of an ego per hour and per million km, with what their uncertainty comes from."""

    ego: str
    """The ego, as it was named."""
    scenarios: tuple[ScenarioRisk, ...]

    @cached_property
    def total(self) -> TotalRate:
        """Sum over the scenarios."""
        return TotalRate(tuple(each.rate for each in self.scenarios))

    @cached_property
    def injuries(self) -> TotalRate | None:
        """Serious injuries (MAIS 3 or more), summed over the scenarios with collisions; None where there are none."""
        rates = tuple(
            replace(each.report.injury_rate, site_log_sd=each.rate.site_log_sd)
            for each in self.scenarios
            if each.report.injury_rate is not None
        )
        return TotalRate(rates) if rates else None

    @property
    def kinds(self) -> dict[str, float]:
        """Collisions per million km by kind of crash, the most frequent first."""
        sums: dict[str, float] = {}
        for each in self.scenarios:
            for kind, rate in each.kinds.items():
                sums[kind] = sums.get(kind, 0.0) + rate
        return dict(sorted(sums.items(), key=lambda kind: -kind[1]))

    @property
    def recorded_events(self) -> dict[str, int]:
        """Recorded events behind each base distribution, by scenario."""
        return {each.name: each.events for each in self.scenarios if each.events is not None}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Doubts about p and about the error of its base distribution, by scenario."""
        return tuple(f"{name_scenario(each.name)}: {text}" for each in self.scenarios for text in each.report.warnings)

    @property
    def notes(self) -> tuple[str, ...]:
        """Errors that are left out, and bases that differ from those asked for."""
        return tuple(f"{name_scenario(each.name)}: {text}" for each in self.scenarios for text in each.notes)

    def __str__(self) -> str:
        """Return the table, for people."""
        total = self.total
        level = f"{100 * total.confidence:g} %: "
        per_km = format_with_interval(total.per_million_km, total.interval_per_million_km, " ", level)
        per_hour = format_with_interval(total.per_hour, total.interval_per_hour, " ", level)
        lines = [
            f"collisions per million km  {per_km}   {describe_human_contacts()}",
            *(f"  {each.describe()}" for each in self.scenarios),
            f"  per hour      {per_hour}",
            *self._describe_kinds(),
            *([] if self.injuries is None else [f"  {describe_injuries(self.injuries)}"]),
        ]
        uncertainty = describe_uncertainty(total, self.recorded_events)
        lines += [uncertainty] if uncertainty else []
        lines += [f"warning: {text}" for text in self.warnings]
        return "\n".join(lines + [f"note: {text}" for text in self.notes])

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        needed = self.total.further_events(self.recorded_events)
        return {
            "ego": self.ego,
            **self.total.to_dict(),
            "scenarios": {each.name: each.to_dict() for each in self.scenarios},
            "kinds_per_million_km": self.kinds,
            "injuries": None if self.injuries is None else self.injuries.to_dict(),
            "further_events": None if needed is None else needed._asdict(),
            "people": [benchmark.to_dict() for benchmark in HUMAN_BENCHMARKS],
            "doubtful": bool(self.warnings),
            "warnings": list(self.warnings),
            "notes": list(self.notes),
            "version": __version__,
        }

    def save_plot(self, path: str | PathLike[str]) -> None:
        """Draw the rates with their intervals and what the uncertainty comes from, and save it as a .png."""
        save_risk_plot(Path(path), self.ego, self.total)

    def _describe_kinds(self) -> list[str]:
        whole = sum(self.kinds.values())
        parts = [f"{kind} {format_rate(rate)} ({format_share(rate / whole)})" for kind, rate in self.kinds.items()]
        return [f"  by kind       {', '.join(parts)}"] if whole > 0 else []
