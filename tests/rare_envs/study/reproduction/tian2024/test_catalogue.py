"""Rows of the tables: the paper's settings."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rare_envs.study.reproduction.tian2024.catalogue import METHOD_ROWS
from samplers.methods.importance_sampling import ImportanceSampling
from samplers.methods.subset_simulation import SubsetSimulation


def test_methods_have_the_settings_of_the_paper() -> None:
    assert METHOD_ROWS["MC"].target_cov == pytest.approx(0.2 / 1.96)
    subsets = METHOD_ROWS["SS"].find_method("IDM")
    assert isinstance(subsets, SubsetSimulation)
    assert (subsets.n, subsets.p0, subsets.distribution) == (500, 0.1, "normal")
    assert [row.max_sim for row in METHOD_ROWS.values() if row.max_sim not in (None, 2_000_000)] == [2681] * 3


def test_the_stack_has_larger_batches_and_nothing_else() -> None:
    ours, stacked = (METHOD_ROWS["IS"].find_method(system) for system in ("IDM", "stack"))
    assert isinstance(ours, ImportanceSampling)
    assert replace(ours, batch=10_000) == stacked
    assert ours != stacked
    assert METHOD_ROWS["ADSS"].find_method("stack") == METHOD_ROWS["ADSS"].find_method("IDM")
