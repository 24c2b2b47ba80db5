"""A record made by hand."""

from __future__ import annotations

from typing import Any

from benchmarks.papers.record import ComparedValue, ComparisonTable, TestedClaim, make_record

TABLE = ComparisonTable(
    name="table9",
    title="Table IX: a table.",
    keys=("method", "system"),
    values=(
        ComparedValue(labels=("SS", "IDM"), quantity="mean of p", paper=8e-4, ours=6e-4, reasons=("traffic",)),
        ComparedValue(
            labels=("SS", "IDM"), quantity="simulations", ours=4980, interval=(4900.0, 5100.0), ours_all_in=5500
        ),
        ComparedValue(labels=("MC", "IDM"), quantity="mean of p", paper=8.36e-4, released="does <not> run"),
    ),
    explanations={"traffic": "Other roads."},
)


def record_by_hand() -> dict[str, Any]:
    finding = TestedClaim(claim="A < B", statistic="A / B", value=0.5, interval=(0.4, 0.6), verdict="holds")
    return make_record(
        title="A paper",
        source="Somebody, 2024.",
        command="python -m benchmarks.papers paper",
        settings={"scale": "small", "seed": 3},
        tables=[TABLE],
        figures={"figure9": {"title": "Figure 9.", "caption": "A line.", "paper": "Another line.", "y": [0.0, 1.0]}},
        findings=[finding],
        notes=["Counted."],
        runs=[{"p": float("nan")}],
    )
