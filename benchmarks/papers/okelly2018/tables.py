"""Tables and figures of the paper beside ours, from what a study has found."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.papers.okelly2018.printed import PRINTED_TABLES, PrintedTable
from benchmarks.papers.okelly2018.search import PRINTED_SEARCH, WHY_OTHER_THRESHOLDS
from benchmarks.papers.record import ComparedValue, ComparisonTable, DrawnFigure

Z_95 = 1.96
MISSED_ERRORS = 3.0
"""Standard errors below the naive p from which failures are said to have been missed."""
FEW_DRAWS = 0.02
"""Effective sample size over rare draws below which a few draws are said to make up an estimate."""
KEYS = ("sample", "gamma, theirs / ours [s]")
SEARCH_COUNTED = "search counted"
_ERROR = "standard error"
_VARIANCE_RATIO = "variance, naive / sampler, equal draws"
_DISTANCE_RATIO = "mean square distance from the naive p instead of the variance"


def make_tables(ego: str, gammas: tuple[float, ...], found: Mapping[str, Any]) -> tuple[ComparisonTable, ...]:
    """Return the table of estimates and that of ratios."""
    printed = PRINTED_TABLES[ego]
    reasons = explain_differences(ego, found)
    heads = [f"{theirs} / {ours}" for theirs, ours in zip(printed.thresholds, gammas, strict=True)]
    estimates = _list_estimates(printed, heads, found)
    ratios = _list_ratios(printed, heads, found)
    return (
        ComparisonTable(
            name=printed.name.lower().replace(" ", ""),
            title=f"{printed.name}: probabilities with the {ego} ego",
            keys=KEYS,
            values=tuple(estimates),
            explanations=_keep_used(reasons, estimates),
            all_in_title=SEARCH_COUNTED,
        ),
        ComparisonTable(
            name=f"{printed.name.lower().replace(' ', '')}_ratios",
            title=f"What cross-entropy gains over naive Monte Carlo with the {ego} ego",
            keys=KEYS,
            values=tuple(ratios),
            explanations=_keep_used(reasons, ratios),
            all_in_title=SEARCH_COUNTED,
        ),
    )


def _keep_used(reasons: Mapping[str, str], values: Iterable[ComparedValue]) -> dict[str, str]:
    """Return the explanations that some value refers to; `underflow` refers to `weights`."""
    used = {reason for value in values for reason in value.reasons}
    used |= {"weights"} if "underflow" in used else set()
    return {name: text for name, text in reasons.items() if name in used}


def explain_differences(ego: str, found: Mapping[str, Any]) -> dict[str, str]:
    """Return sentences by the names that values have as reasons."""
    printed = found["searches"][PRINTED_SEARCH]
    texts = {
        "thresholds": WHY_OTHER_THRESHOLDS[ego],
        "scale": _explain_scale(PRINTED_TABLES[ego], found["naive"]),
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
    if "sampler" not in printed:
        return texts
    sampler = printed["sampler"]
    texts["weights"] = (
        "The 404 weights of our drivers have standard deviations of 0.001 to 0.004, so that the paper's box of 0.01 is "
        f"some of them wide; the mean moved by {sampler['shift']:.3g} of them (Mahalanobis). The likelihood ratio of "
        f"equation 3 then hardly ever is of any size: its mean over the final draws is {printed['mean_ratio']:.2g}, "
        "where it should be 1, so p is too small, and its standard error says nothing. The paper's covariance was not "
        "released; their mean ratio must have been near 1. `starts alone` leaves the weights as they are."
    )
    return texts


def _explain_scale(printed: PrintedTable, naive: list[dict[str, Any]]) -> str:
    """Return what the numbers of rollouts make of a difference."""
    if naive and naive[0]["n"] >= printed.draws["naive"]:
        return "One run of each row with one seed, of as many rollouts as theirs: beside other reasons there is chance."
    return "One run, with fewer rollouts than theirs; the rows say how many."


def _list_estimates(printed: PrintedTable, heads: list[str], found: Mapping[str, Any]) -> list[ComparedValue]:
    searches = found["searches"]
    rows: list[tuple[str, str | None, list[dict[str, Any]], tuple[str, ...]]] = [
        ("naive", "naive", found["naive"], ("thresholds", "scale")),
        ("naive, equal draws", "naive, equal draws", found["naive_equal"], ("thresholds", "scale")),
        *(
            (
                f"cross-entropy, {name}",
                "cross-entropy" if name == PRINTED_SEARCH else None,
                each["estimates"],
                ("thresholds", "weights", "scale") if each["weights_move"] else ("extra",),
            )
            for name, each in searches.items()
        ),
    ]
    values: list[ComparedValue] = []
    for label, row, estimates, reasons in rows:
        if row not in printed.rows and not estimates:
            values.append(_not_run(label))
            continue
        values.append(_count_rollouts(label, row, printed, estimates, searches.get(label.partition(", ")[2])))
        for j, head in enumerate(heads):
            paper = printed.rows[row][j] if row in printed.rows else (None, None)
            values += _pair(label, head, paper, estimates[j] if estimates else None, reasons)
    for own in found["own"]:
        head = next(each for each in heads if each.endswith(f" {own['gamma']}"))
        labels = (f"our default method, {own['n_sim']:,} simulations all in", head)
        values += [
            ComparedValue(labels=labels, quantity="rollouts", ours_all_in=own["n_sim"], reasons=("extra",)),
            ComparedValue(
                labels=labels, quantity="p", ours=own["p"], interval=(own["low"], own["high"]), reasons=("extra",)
            ),
            ComparedValue(labels=labels, quantity=_ERROR, ours=own["p"] * own["cov"], reasons=("extra",)),
        ]
    return values


def _count_rollouts(
    label: str,
    row: str | None,
    printed: PrintedTable,
    estimates: list[dict[str, Any]],
    search: Mapping[str, Any] | None,
) -> ComparedValue:
    """Return the rollouts of a row, and with those of its search."""
    theirs = printed.draws.get(row or "")
    ours = estimates[0]["n"] if estimates else None
    return ComparedValue(
        labels=(_label_rollouts(label, ours), "all"),
        quantity="rollouts",
        paper=theirs,
        ours=ours,
        paper_all_in=None if theirs is None else theirs + (printed.search if search else 0),
        ours_all_in=None if ours is None else ours + (search["search"] if search else 0),
        reasons=("not run",) if ours is None else ("search", "scale") if search else ("scale",),
    )


def _label_rollouts(label: str, n: int | None) -> str:
    return f"{label}: not run" if n is None else f"{label}, {n:,} rollouts"


def _not_run(label: str) -> ComparedValue:
    """Return the one line of a row that the paper does not have and that was not run."""
    return ComparedValue(labels=(f"{label}: not run", "all"), quantity="all", reasons=("not run",))


def _pair(
    label: str,
    head: str,
    paper: tuple[float | None, float | None],
    ours: Mapping[str, Any] | None,
    reasons: tuple[str, ...],
) -> list[ComparedValue]:
    """Return an estimate and its standard error."""
    if ours is None:
        labels = (_label_rollouts(label, None), head)
        return [
            ComparedValue(labels=labels, quantity=quantity, paper=value, reasons=("not run",))
            for quantity, value in zip(("p", _ERROR), paper, strict=True)
        ]
    p, error = ours["p"], ours["standard_error"]
    around = (max(0.0, p - Z_95 * error), p + Z_95 * error) if error > 0.0 else None
    interval = ours["interval"] or around
    labels = (_label_rollouts(label, ours["n"]), head)
    return [
        ComparedValue(
            labels=labels,
            quantity=f"p ({ours['events']:,} events)",
            paper=paper[0],
            ours=p,
            interval=None if interval is None else tuple(interval),
            reasons=reasons,
        ),
        ComparedValue(labels=labels, quantity=_ERROR, paper=paper[1], ours=error, reasons=reasons),
    ]


def _list_ratios(printed: PrintedTable, heads: list[str], found: Mapping[str, Any]) -> list[ComparedValue]:
    values: list[ComparedValue] = []
    for name, each in found["searches"].items():
        of_paper = name == PRINTED_SEARCH
        if not of_paper and not each["comparisons"]:
            values.append(_not_run(f"cross-entropy, {name}"))
            continue
        for j, head in enumerate(heads):
            ratio = printed.variance_ratio(j) if of_paper else None
            draws = printed.draws["cross-entropy"]
            all_in = None if ratio is None else ratio * draws / (draws + printed.search)
            theirs = (ratio, all_in, printed.errors_off(j) if of_paper else None)
            known = each["comparisons"][j] if each["comparisons"] else None
            few = bool(each["estimates"]) and _rests_on_few(each["estimates"][j])
            values += _ratios_of(f"cross-entropy, {name}", head, theirs, known, each, few)
    for own in found["own"]:
        head = next(each for each in heads if each.endswith(f" {own['gamma']}"))
        values.append(
            ComparedValue(
                labels=(f"our default method, {own['n_sim']:,} simulations all in", head),
                quantity=_VARIANCE_RATIO,
                ours_all_in=own["gain"],
                reasons=("extra",) if own["gain"] is not None else ("no event",),
            )
        )
    return values


def _rests_on_few(estimate: Mapping[str, Any]) -> bool:
    """Return whether a few draws make up an estimate."""
    ess = estimate.get("ess")
    return ess is not None and ess < FEW_DRAWS * estimate["events"]


def _ratios_of(
    label: str,
    head: str,
    theirs: tuple[float | None, float | None, float | None],
    known: Mapping[str, Any] | None,
    search: Mapping[str, Any],
    few: bool,
) -> list[ComparedValue]:
    """Return the ratios of one search at one threshold; `few` says whether its estimate rests on few draws."""
    if known is None:
        labels, missing = (f"{label}: {search['iterations']} of {search['of']} iterations run", head), ("not run",)
        known = {
            name: None
            for name in ("events_ratio", "events_interval", "variance_ratio", "all_in", "error_ratio", "errors_off")
        }
    else:  # a standard error of 0 is one below the smallest number
        labels, missing = (label, head), ("no event",) if known["events_ratio"] is None else ("underflow",)
    why = ("thresholds", "weights", "scale") if search["weights_move"] and "sampler" in search else ("thresholds",)
    low = known["errors_off"] is not None and known["errors_off"] < -MISSED_ERRORS
    why = (*why, "missed") if low and not search["weights_move"] else why
    of_weights = (*why, "few draws") if few and not search["weights_move"] else why
    ratio, all_in, off = theirs
    rows = (
        ("rare events, sampler / naive, equal draws", (None, None), (known["events_ratio"], None), why),
        (_VARIANCE_RATIO, (ratio, all_in), (known["variance_ratio"], known["all_in"]), ("search", *of_weights)),
        (_DISTANCE_RATIO, (None, None), (None, known["error_ratio"]), ("search", *of_weights)),
        ("p less the naive p, in joint standard errors", (off, None), (known["errors_off"], None), of_weights),
    )
    return [
        ComparedValue(
            labels=labels,
            quantity=quantity,
            paper=paper[0],
            paper_all_in=paper[1],
            ours=ours[0],
            ours_all_in=ours[1],
            interval=known["events_interval"] if quantity.startswith("rare events") else None,
            reasons=reasons if any(value is not None for value in ours) else missing,
        )
        for quantity, paper, ours, reasons in rows
    ]


POINTS = 16
"""Thresholds of a curve."""
_SHOWN_RATIOS = (1e-4, 1e4)
"""Ratios beyond are drawn at the edge: a sample variance of 0 says nothing."""


def list_thresholds(gammas: tuple[float, ...]) -> list[float]:
    """Return the thresholds of the curves, from the rarest in the table to a tenth beyond its last.

    Example:
        >>> thresholds = list_thresholds((0.4, 0.5))
        >>> len(thresholds), thresholds[0], thresholds[-1]
        (16, 0.4, 0.55)
    """
    return [round(float(gamma), 4) for gamma in np.linspace(gammas[0], 1.1 * gammas[-1], POINTS)]


def describe_figures(ego: str, found: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the data of both figures of an ego as a record has them."""
    printed = PRINTED_TABLES[ego]
    word = printed.figure.lower().replace(" ", "")
    curves = {name: each["curve"] for name, each in found["searches"].items() if each.get("curve")}
    words = (
        ("a", "number of rare events, sampler / naive Monte Carlo, at equal draws", "events_ratio", printed.events),
        ("b", "variance, naive Monte Carlo / sampler, at equal draws", "variance_ratio", printed.variance),
    )
    return {
        f"{word}{letter}": {
            "title": f"{printed.figure}{letter}: {title}",
            "caption": "A curve for each search; without the rollouts of the search, as in the paper."
            + ("" if curves else " Not run yet."),
            "paper": f"{range_}.",
            "axis": title,
            "curves": {
                name: {"gamma": [p["gamma"] for p in curve], "ratio": [p[key] for p in curve]}
                for name, curve in curves.items()
            },
        }
        for letter, title, key, range_ in words
    }


def make_figures(record: Mapping[str, Any]) -> list[DrawnFigure]:
    """Return the figures of a record, those without curves left out."""
    return [
        DrawnFigure(name, partial(draw_ratios, data=data), (7.0, 4.0))
        for name, data in record["figures"].items()
        if data["curves"]
    ]


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
