"""Files of fitted base distributions with refits and frequencies, under which crashes are common."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from rare_envs.scenarios.registry import find_scenario

MEANS = {
    "cut_in": (20.0, 14.0, 20.0, 9.5, 30.0, 3.5, 4.0, -5.0, -3.0, 0.0, 0.0, 0.0, 0.0),  # who does not look or notice
    "hard_brake": (25.0, 12.0, 9.0, 40.0),
    "car_following": (20.0, 10.0, 26.0),
}
SPREADS = {
    "cut_in": (2.0, 2.0, 2.0, 2.0, 5.0, 0.2, 0.5, 0.3, 0.3, 1.0, 1.0, 1.0, 1.0),
    "hard_brake": (2.0, 2.0, 0.5, 2.0),
    "car_following": (2.0, 2.0, 5.0),
}
"""Of independent normal variables, so that between a tenth and a half of the scenarios end in a crash of the IDM."""
FREQUENCIES = {
    "cut_in": {"count": 1221, "hours": 112.0, "km": 3900.0, "share": 38 / 46, "share_events": 46},
    "hard_brake": {"count": 42, "hours": 5.64, "km": 218.0},
    "car_following": {"count": 153, "hours": 5.98, "km": 169.7},
}
EVENTS = {"cut_in": ([38, 15], 17), "hard_brake": ([42], 40), "car_following": ([470], 28)}


def fitted_entries(scenario: str, spread: float = 0.3, shift: float = 0.0, **changes: Any) -> dict[str, Any]:
    """Return the entries of a fitted base; a change to None leaves a key out.

    The means of the 30 refits differ by `spread`, those of the base are moved by `shift`, in standard deviations of it.
    """
    parameters = find_scenario(scenario).parameters
    sd = np.array(SPREADS[scenario])
    mean = np.array(MEANS[scenario]) + shift * sd
    rng = np.random.default_rng(0)
    used, clusters = EVENTS[scenario]
    shape = {"weights": [1.0], "covariances": [np.diag(sd**2).tolist()]}
    moved = mean + spread * sd * rng.standard_normal((30, len(sd)))
    source = {"site": f"site of {scenario}", "date": "2005-06-15", "data": f"data of {scenario}", "licence": "CC0"}
    entries = {
        "names": [p.name for p in parameters],
        "low": [max(p.low, -150.0) for p in parameters],
        "high": [min(p.high, 150.0) for p in parameters],
        **shape,
        "means": [mean.tolist()],
        "refits": [{**shape, "means": [each.tolist()]} for each in moved],
        "events": {"used": used, "clusters": clusters, "cluster": "scene"},
        "family": "1 component",
        "frequency": {**FREQUENCIES[scenario], "definition": "events of a test", "source": "a test"},
        "checks": [{"name": "TTC < 5 s", "recorded": 2, "expected": 7.5}],
        "provenance": {"source": source, "bic": 1086.8, "held_out_log_prob": -14.6, "coordinates": "plain"},
        **changes,
    }
    return {name: value for name, value in entries.items() if value is not None}


def write_fitted(path: Path, scenario: str, **changes: Any) -> str:
    """Write `fitted_entries` and return the name of the file."""
    path.write_text(json.dumps(fitted_entries(scenario, **changes)))
    return str(path)


def write_stratified(path: Path, spread: float = 0.3) -> str:
    """Write a base of brakings of two kinds, with refits that have shares of their own; return the name of the file."""
    entries = fitted_entries("hard_brake", spread=spread)
    shape = {key: entries.pop(key) for key in ("weights", "covariances", "means")}
    box = {"low": entries.pop("low"), "high": entries.pop("high"), "coordinates": ["plain"] * 4}
    means, refits = shape["means"][0], entries.pop("refits")
    kinds = {
        "slowing": (0.8, 21.0, [["loss", "speed", -150.0, -1.0]]),
        "stop": (0.2, 40.0, [["loss", "speed", 0.0, 150.0]]),
    }

    def place(loss: float, means: list[float]) -> dict[str, Any]:
        return {**shape, "means": [[*means[:3], loss]]}

    strata = [
        {"name": name, "share": share, **box, "within": within, **place(loss, means)}
        for name, (share, loss, within) in kinds.items()
    ]
    rng = np.random.default_rng(1)
    own = []
    for refit in refits:
        stop = 0.2 * float(np.exp(0.2 * rng.standard_normal()))
        shares = {"slowing": 1.0 - stop, "stop": stop}
        own.append({"strata": [{"share": shares[k], **place(kinds[k][1], refit["means"][0])} for k in kinds]})
    told = {"strata": strata, "limits": [-0.5], "column": 3, "less": 0}
    path.write_text(json.dumps({**entries, **told, "refits": own}))
    return str(path)
