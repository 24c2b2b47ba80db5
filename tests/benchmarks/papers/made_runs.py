"""Replications made by hand, without a simulation."""

from __future__ import annotations

from typing import Any

from benchmarks.papers.tian2024.replications import ReplicationJob

SIMULATIONS = {"MC": 300_000, "IS": 3000, "SS": 1800, "ADSS": 1850}


def made_run(job: ReplicationJob, p: float | None = None) -> dict[str, Any]:
    """Return a run whose estimate alternates by the seed: 1.5e-4, 2.5e-4, ..."""
    n = SIMULATIONS.get(job.method, 2681)
    p = (1.5e-4, 2.5e-4)[job.seed % 2] if p is None else p
    moved = [[30.0, 28.0, 30.0, 35.0, 40.0, 3.7], [30.0, 24.0 + 0.1 * job.seed, 30.0, 5.0, 40.0, 3.7]]
    points = [[[30.0, 28.0, 30.0, 35.0, 40.0, 3.7]] * 2, [[30.0, 24.0, 30.0, 5.0, 40.0, 3.6]]]
    return {
        "scenario": job.scenario,
        "system": job.system,
        "method": job.method,
        "seed": job.seed,
        "p": p,
        "low": 0.5 * p,
        "high": float("inf"),
        "cov": 0.3,
        "n_sim": n,
        "simulated": n,
        "final": n // 2 if job.method == "IS" else n,
        "levels": 4,
        "warnings": ["a warning"],
        "trace": [[n // 2, p, 1.0], [n, p, 0.0]],
        "level_means": moved if job.points else [],
        "level_points": points if job.points else [],
    }
