"""Events of several recordings: pooled, and written so that the recipes can read them."""

import csv

import numpy as np
import pytest

from training.data.event_tables import EXTRACTORS, concatenate_events, write_events
from training.data.synthetic import synthetic_traffic
from training.scenario_fitting.event_filters import EVENT_RECIPES, read_events

EVENTS = {
    "recording": np.array(["a", "a"]),
    "ego": np.array([-1, 4]),
    "v_ego": np.array([np.nan, 12.34567]),
}


def test_missing_values_are_empty_fields(tmp_path):
    write_events(EVENTS, tmp_path / "events.csv")
    with (tmp_path / "events.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["v_ego"] for row in rows] == ["", "12.3457"]
    assert [row["ego"] for row in rows] == ["-1", "4"]


def test_pooled_events_keep_their_order():
    pooled = concatenate_events([EVENTS, {name: values[:1] for name, values in EVENTS.items()}])
    assert pooled["ego"].tolist() == [-1, 4, -1]
    with pytest.raises(ValueError, match="at least one recording, got none"):
        concatenate_events([])


@pytest.mark.parametrize("scenario", list(EXTRACTORS))
def test_files_of_events_have_the_columns_of_their_recipe(scenario, tmp_path):
    events = EXTRACTORS[scenario](synthetic_traffic(seconds=5.0))
    write_events(events, tmp_path / "events.csv")
    recipe = EVENT_RECIPES[scenario]
    read = read_events(tmp_path / "events.csv", recipe)
    assert {len(values) for values in read.values()} == {len(next(iter(events.values())))}
