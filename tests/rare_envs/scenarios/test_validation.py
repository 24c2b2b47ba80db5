"""Trial of a scenario: what it is given, and what is refused in which words."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from rare_envs.scenarios.base import Others, Scenario
from rare_envs.scenarios.base_distributions import try_scenario
from rare_envs.scenarios.registry import SCENARIOS
from tests.rare_envs.scenarios.standing import STANDING, driven, initial, others


def without_a_value(function: Callable[..., Any], field: str) -> Callable[..., Any]:
    """The same function with NaN in one field of one row."""

    def broken(*arguments: Any) -> Any:
        fields = function(*arguments)
        value = getattr(fields, field).clone()
        value[3] = torch.nan
        return fields._replace(**{field: value})

    return broken


@pytest.mark.parametrize("env_id", SCENARIOS)
def test_the_shipped_scenarios_pass(env_id: str) -> None:
    try_scenario(SCENARIOS[env_id])


GOOD_BASE = STANDING.bases["even"]
"""Of two columns."""


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bases": {"even": {"alpha": [1.0], "beta": [1.0]}}}, r"^Base distribution even: Expected alpha, beta, low"),
        (
            {"bases": {"even": GOOD_BASE, "odd": {"weights": [1.0]}}},
            "^Base distribution odd: Missing means, covariances",
        ),
        ({"initial": lambda x: None}, r"expected initial\(x\) to give a State, got NoneType\.$"),
        (
            {"initial": lambda x: initial(x)._replace(theta=x[:3])},
            r"expected theta of 8 rows, got \(3, 2\)\.$",
        ),
        (
            {"vehicle_names": ("ego", "stalled", "ghost"), "labels": ()},
            r"expected x of shape \(B, 3\) from initial\(x\), got \(8, 2\) for B = 8\.$",
        ),
        (
            {"initial": lambda x: initial(x)._replace(speed=x[:, 0])},
            r"expected speed of shape \(B, 2\) from initial\(x\), got \(8,\) for B = 8\.$",
        ),
        ({"initial": without_a_value(initial, "heading")}, r"heading from initial\(x\) is not finite\.$"),
        (
            {"others": lambda state, dt: None},
            r"expected others\(state, dt\) to give x, y, heading and speed, as State or Others; got None\.$",
        ),
        ({"others": lambda state, dt: others(state, dt)[:3]}, r"expected others\(state, dt\) to give x, y, heading"),
        ({"others": lambda state, dt: Others(1, 2, 3, 4)}, r"heading and speed, as State or Others; got Others\(x=1"),
        ({"others": without_a_value(others, "y")}, r"y from others\(state, dt\) is not finite\.$"),
        (
            {"driven": lambda state, action, dt: Others(*state[:4])},
            r"expected x of shape \(B, 1\) from driven\(state, action, dt\), got \(8, 2\) for B = 8\.$",
        ),
        ({"driven": without_a_value(driven, "speed")}, r"speed from driven\(state, action, dt\) is not finite\.$"),
    ],
)
def test_what_does_not_work_is_refused(change: dict[str, Any], message: str) -> None:
    scenario: Scenario = replace(STANDING, **change)
    with pytest.raises(ValueError, match=message) as caught:
        try_scenario(scenario)
    assert str(caught.value).startswith(("Scenario 'standing': ", "Base distribution "))
