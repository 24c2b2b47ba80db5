"""The paper's numbers and what follows from them."""

import pytest

from rare_envs.study.reproduction.okelly2018.printed import PRINTED_TABLES, describe_printed


def test_variance_ratios_of_table_1() -> None:
    assert PRINTED_TABLES["lidar"].variance_ratio(1) == pytest.approx(3.6, abs=0.05)


@pytest.mark.parametrize("ego", PRINTED_TABLES)
def test_rows_have_a_value_for_each_threshold(ego: str) -> None:
    printed = describe_printed(ego)
    assert {len(row) for row in printed["rows"].values()} == {len(printed["thresholds"])} == {4}
    assert set(printed["rows"]) == set(printed["draws"])
