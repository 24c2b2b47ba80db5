"""Tables and figures of the paper as printed, and beside ours from what a study has found.

References:
    O'Kelly, Sinha, Namkoong, Duchi and Tedrake, "Scalable end-to-end autonomous vehicle testing via rare-event
    simulation", NeurIPS 2018, section 4.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.papers.okelly2018.study import PRINTED_SEARCH, WHY_OTHER_THRESHOLDS
from benchmarks.papers.record import Drawings, Entry, compare, make_table

PRINTED_TABLES: dict[str, dict[str, Any]] = {
    "lidar": {
        "table": "Table 1",
        "figure": "Figure 2",
        "thresholds": [0.14, 0.15, 0.19, 0.20],
        "draws": {"naive": 1_300_000, "cross-entropy": 100_000, "naive, equal draws": 100_000},
        "rows": {
            "naive": [[12.4e-6, 3.1e-6], [80.6e-6, 7.91e-6], [133e-5, 3.2e-5], [186e-5, 3.79e-5]],
            "cross-entropy": [[19.8e-6, 8.88e-6], [66.1e-6, 15e-6], [108e-5, 9.51e-5], [164e-5, 14e-5]],
            "naive, equal draws": [[20e-6, 14.1e-6], [100e-6, 31.6e-6], [132e-5, 11.5e-5], [185e-5, 13.6e-5]],
        },
        "search": 500_000,
        "events": "3 to 10 times",
        "variance": "2 to 16 times",
    },
    "vision": {
        "table": "Table 2",
        "figure": "Figure 3",
        "thresholds": [0.22, 0.23, 0.24, 0.25],
        "draws": {"naive": 50_000, "cross-entropy": 50_000},
        "rows": {
            "naive": [[11.3e-5, 4.6e-5], [20.6e-5, 6.22e-5], [43.2e-5, 9e-5], [6.75e-4, 1.13e-4]],
            "cross-entropy": [[5.87e-5, 1.82e-5], [13.0e-5, 2.94e-5], [19.0e-5, 3.14e-5], [4.52e-4, 1.35e-4]],
        },
        "search": 20_000,
        "events": "up to 18 times",
        "variance": "lower, no number is printed",
    },
}
"""The tables by ego.

Thresholds are their gamma [s]; draws the rollouts behind each row, without those of the search, which their table
leaves out; a row has an estimate and its standard error for each threshold; events and variance are what their figure
shows, in words.
"""


def find_variance_ratio(ego: str, j: int) -> float:
    """Return the variance of naive Monte Carlo over that of cross-entropy at equal draws and the j-th threshold.

    That of naive Monte Carlo is p (1 - p) / n with p of its longest row.
    """
    rows, n = PRINTED_TABLES[ego]["rows"], PRINTED_TABLES[ego]["draws"]["cross-entropy"]
    p, error = float(rows["naive"][j][0]), float(rows["cross-entropy"][j][1])
    return p * (1.0 - p) / n / error**2


def find_errors_off(ego: str, j: int) -> float:
    """Return the distance of cross-entropy from the longest naive row, in their joint standard error."""
    (p, error), (found, own) = (PRINTED_TABLES[ego]["rows"][row][j] for row in ("naive", "cross-entropy"))
    return float((found - p) / math.hypot(error, own))


def describe_printed(ego: str) -> dict[str, Any]:
    """Return a table of the paper, with what follows from it."""
    table = PRINTED_TABLES[ego]
    return {**table, "variance_ratios": [find_variance_ratio(ego, j) for j in range(len(table["thresholds"]))]}


Z_95 = 1.96
MISSED_ERRORS = 3.0
"""Standard errors below the naive p from which failures are said to have been missed."""
FEW_DRAWS = 0.02
"""Effective sample size over rare draws below which a few draws are said to make up an estimate."""
KEYS = ("sample", "gamma, theirs / ours [s]")
_ERROR = "standard error"
_VARIANCE_RATIO = "variance, naive / sampler, equal draws"
_DISTANCE_RATIO = "mean square distance from the naive p instead of the variance"


def make_tables(ego: str, gammas: Sequence[float], found: Mapping[str, Any]) -> list[Entry]:
    """Return the table of estimates and that of ratios."""
    name, reasons = PRINTED_TABLES[ego]["table"], explain_differences(ego, found)
    word = name.lower().replace(" ", "")
    ratios = f"What cross-entropy gains over naive Monte Carlo with the {ego} ego"
    return [
        make_table(of_table, title, KEYS, list(values(ego, gammas, found)), reasons, all_in_title="search counted")
        for of_table, title, values in (
            (word, f"{name}: probabilities with the {ego} ego", _list_estimates),
            (f"{word}_ratios", ratios, _list_ratios),
        )
    ]


def explain_differences(ego: str, found: Mapping[str, Any]) -> dict[str, str]:
    """Return sentences by the names that values have as reasons."""
    printed, naive = found["searches"][PRINTED_SEARCH], found["naive"]
    whole = bool(naive) and naive[0]["n"] >= PRINTED_TABLES[ego]["draws"]["naive"]
    beside = "of as many rollouts as theirs: beside other reasons there is chance."
    texts = {
        "thresholds": WHY_OTHER_THRESHOLDS[ego],
        "scale": f"One run of each row with one seed, {beside}"
        if whole
        else "One run, with fewer rollouts than theirs; the rows say how many.",
        "search": "Their tables leave out the rollouts of the search; here they are counted.",
        "not run": "These rollouts were not made.",
        "no event": "Too rare for as many rollouts: nothing to compare with.",
        "missed": (
            "The search follows some of the failures and leaves the others out: p is then too small by more than its "
            "standard error can say, and the ratio of variances, which has no other source, says nothing. In the "
            "paper's Table 2 all four means of cross-entropy are below those of naive Monte Carlo as well."
        ),
        "few draws": (
            f"The effective sample size of the rare draws is below {FEW_DRAWS:.0%} of their number: a few large "
            "likelihood ratios make up the estimate, so that its standard error is itself uncertain."
        ),
        "underflow": "The standard error is below the smallest number of the machine, for the reason `weights`.",
        "extra": "Not in the paper.",
    }
    if "sampler" in printed:
        shift, ratio = f"{printed['sampler']['shift']:.3g}", f"{printed['mean_ratio']:.2g}"
        texts["weights"] = (
            "The 404 weights of our drivers have standard deviations of 0.001 to 0.004, so that the paper's box of "
            f"0.01 is some of them wide; the mean moved by {shift} of them (Mahalanobis). The likelihood ratio of "
            f"equation 3 then hardly ever is of any size: its mean over the final draws is {ratio}, where it should be "
            "1, so p is too small, and its standard error says nothing. The paper's covariance was not released; their "
            "mean ratio must have been near 1. `starts alone` leaves the weights as they are."
        )
    return texts


def _heads(ego: str, gammas: Sequence[float]) -> list[str]:
    return [f"{theirs} / {ours}" for theirs, ours in zip(PRINTED_TABLES[ego]["thresholds"], gammas, strict=True)]


def _list_estimates(ego: str, gammas: Sequence[float], found: Mapping[str, Any]) -> Iterator[Entry]:
    """Yield rollouts, p and standard error of naive Monte Carlo, of each search and of our default method."""
    for name in ("naive", "naive, equal draws"):
        estimates = found["naive" if name == "naive" else "naive_equal"]
        yield from _row_of_estimates(ego, gammas, name, name, estimates, ("thresholds", "scale"), None)
    for name, search in found["searches"].items():
        row = "cross-entropy" if name == PRINTED_SEARCH else ""
        reasons = ("thresholds", "weights", "scale") if search["weights_move"] else ("extra",)
        yield from _row_of_estimates(ego, gammas, f"cross-entropy, {name}", row, search["estimates"], reasons, search)
    for own in found["own"]:
        labels, extra = _label_own(ego, gammas, own), ("extra",)
        yield compare(labels, "rollouts", ours_all_in=own["n_sim"], reasons=extra)
        yield compare(labels, "p", ours=own["p"], interval=(own["low"], own["high"]), reasons=extra)
        yield compare(labels, _ERROR, ours=own["p"] * own["cov"], reasons=extra)


def _label_own(ego: str, gammas: Sequence[float], own: Mapping[str, Any]) -> tuple[str, str]:
    head = _heads(ego, gammas)[list(gammas).index(own["gamma"])]
    return f"our default method, {own['n_sim']:,} simulations all in", head


def _row_of_estimates(
    ego: str,
    gammas: Sequence[float],
    label: str,
    row: str,
    estimates: Sequence[Mapping[str, Any]],
    reasons: tuple[str, ...],
    search: Mapping[str, Any] | None,
) -> Iterator[Entry]:
    """Yield the rollouts of a row, and with those of its search, then p and standard error at each threshold."""
    table = PRINTED_TABLES[ego]
    if row not in table["rows"] and not estimates:
        yield compare((f"{label}: not run", "all"), "all", reasons=("not run",))
        return
    theirs, ours = table["draws"].get(row), estimates[0]["n"] if estimates else None
    label = f"{label}, {ours:,} rollouts" if ours else f"{label}: not run"
    yield compare(
        (label, "all"),
        "rollouts",
        theirs,
        ours=ours,
        paper_all_in=theirs and theirs + (table["search"] if search else 0),
        ours_all_in=ours and ours + (search["search"] if search else 0),
        reasons=("not run",) if ours is None else ("search", "scale") if search else ("scale",),
    )
    for j, head in enumerate(_heads(ego, gammas)):
        p, error = table["rows"][row][j] if row in table["rows"] else (None, None)
        if not estimates:
            for quantity, value in (("p", p), (_ERROR, error)):
                yield compare((label, head), quantity, value, reasons=("not run",))
            continue
        own = estimates[j]
        half = Z_95 * own["standard_error"]
        around = (max(0.0, own["p"] - half), own["p"] + half) if half > 0.0 else None
        interval = own["interval"] or around
        events = f"p ({own['events']:,} events)"
        yield compare((label, head), events, p, ours=own["p"], interval=interval, reasons=reasons)
        yield compare((label, head), _ERROR, error, ours=own["standard_error"], reasons=reasons)


def _list_ratios(ego: str, gammas: Sequence[float], found: Mapping[str, Any]) -> Iterator[Entry]:
    """Yield the ratios of each search at each threshold, and the gain of our default method."""
    draws, n_search = PRINTED_TABLES[ego]["draws"]["cross-entropy"], PRINTED_TABLES[ego]["search"]
    for name, search in found["searches"].items():
        printed, label = name == PRINTED_SEARCH, f"cross-entropy, {name}"
        if not printed and not search["comparisons"]:
            yield compare((f"{label}: not run", "all"), "all", reasons=("not run",))
            continue
        for j, head in enumerate(_heads(ego, gammas)):
            theirs: dict[str, float] = {}
            if printed:
                ratio = find_variance_ratio(ego, j)
                theirs = {"variance_ratio": ratio, "all_in": ratio * draws / (draws + n_search)}
                theirs["errors_off"] = find_errors_off(ego, j)
            yield from _ratios_of(label, head, theirs, search, j)
    for own in found["own"]:
        reasons = ("extra",) if own["gain"] is not None else ("no event",)
        yield compare(_label_own(ego, gammas, own), _VARIANCE_RATIO, ours_all_in=own["gain"], reasons=reasons)


def _ratios_of(
    label: str, head: str, theirs: Mapping[str, float], search: Mapping[str, Any], j: int
) -> Iterator[Entry]:
    """Yield the ratios of one search at the j-th threshold."""
    known: Mapping[str, Any] = search["comparisons"][j] if search["comparisons"] else {}
    why: tuple[str, ...] = ("thresholds",)
    if not known:
        label, missing = f"{label}: {search['iterations']} of {search['of']} iterations run", ("not run",)
    else:  # a standard error of 0 is one below the smallest number
        missing = ("no event",) if known["events_ratio"] is None else ("underflow",)
    of_weights = why
    if search["weights_move"]:
        why = of_weights = ("thresholds", "weights", "scale") if "sampler" in search else why
    elif known:
        off, estimate = known["errors_off"], search["estimates"][j] if search["estimates"] else {}
        few = estimate.get("ess") is not None and estimate["ess"] < FEW_DRAWS * estimate["events"]
        why = (*why, "missed") if off is not None and off < -MISSED_ERRORS else why
        of_weights = (*why, "few draws") if few else why
    for quantity, name, all_in, reasons in (
        ("rare events, sampler / naive, equal draws", "events_ratio", "", why),
        (_VARIANCE_RATIO, "variance_ratio", "all_in", ("search", *of_weights)),
        (_DISTANCE_RATIO, "", "error_ratio", ("search", *of_weights)),
        ("p less the naive p, in joint standard errors", "errors_off", "", of_weights),
    ):
        ours, ours_all_in = known.get(name), known.get(all_in)
        yield compare(
            (label, head),
            quantity,
            theirs.get(name),
            paper_all_in=theirs.get(all_in),
            ours=ours,
            ours_all_in=ours_all_in,
            interval=known.get("events_interval") if name == "events_ratio" else None,
            reasons=reasons if ours is not None or ours_all_in is not None else missing,
        )


POINTS = 16
"""Thresholds of a curve."""
_SHOWN_RATIOS = (1e-4, 1e4)
"""Ratios beyond are drawn at the edge: a sample variance of 0 says nothing."""


def list_thresholds(gammas: Sequence[float]) -> list[float]:
    """Return the thresholds of the curves, from the rarest in the table to a tenth beyond its last."""
    return [round(float(gamma), 4) for gamma in np.linspace(gammas[0], 1.1 * gammas[-1], POINTS)]


def describe_figures(ego: str, found: Mapping[str, Any]) -> dict[str, Entry]:
    """Return the data of both figures of an ego as a record has them."""
    printed = PRINTED_TABLES[ego]
    figure = printed["figure"]
    curves = {name: each["curve"] for name, each in found["searches"].items() if each.get("curve")}
    words = (
        ("a", "number of rare events, sampler / naive Monte Carlo, at equal draws", "events_ratio", "events"),
        ("b", "variance, naive Monte Carlo / sampler, at equal draws", "variance_ratio", "variance"),
    )
    return {
        f"{figure.lower().replace(' ', '')}{letter}": {
            "title": f"{figure}{letter}: {title}",
            "caption": "A curve for each search; without the rollouts of the search, as in the paper."
            + ("" if curves else " Not run yet."),
            "paper": f"{printed[theirs]}.",
            "axis": title,
            "curves": {
                name: {"gamma": [p["gamma"] for p in curve], "ratio": [p[key] for p in curve]}
                for name, curve in curves.items()
            },
        }
        for letter, title, key, theirs in words
    }


def make_figures(record: Mapping[str, Any]) -> Drawings:
    """Return the figures of a record, those without curves left out."""
    figures = {name: data for name, data in record["figures"].items() if data["curves"]}
    return {name: (partial(draw_ratios, data=data), (7.0, 4.0)) for name, data in figures.items()}


def draw_ratios(figure: Figure, data: Mapping[str, Any]) -> None:
    """Draw ratios against the threshold, both as in the paper, the ratio on a logarithmic axis."""
    axes = figure.subplots()
    for name, curve in data["curves"].items():
        known = [(g, r) for g, r in zip(curve["gamma"], curve["ratio"], strict=True) if r]
        gammas, ratios = [g for g, _ in known], [r for _, r in known]
        label = name if known else f"{name}: none can be computed"
        axes.plot(gammas, np.clip(ratios, *_SHOWN_RATIOS), marker="o", markersize=3, label=label)
    axes.axhline(1.0, color="0.6", linewidth=0.8)
    axes.set_yscale("log")
    axes.set_xlabel("threshold gamma [s]")
    axes.set_ylabel("ratio")
    axes.set_title(data["axis"], fontsize=9)
    axes.legend(fontsize=8)
