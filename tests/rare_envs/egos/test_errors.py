"""Errors of egos in one line, and what survives them."""

import pytest

from rare_envs.egos.errors import EgoGone, NoAnswer, reason_of


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (RuntimeError("no\n  road"), "RuntimeError: no road"),
        (ValueError("Expected this, got that."), "Expected this, got that."),
        (ValueError(), "ValueError()"),
        (SystemExit(7), "SystemExit(7)"),
        (NoAnswer("within 10 s"), "NoAnswer: within 10 s"),
    ],
)
def test_reasons_are_one_line(error: BaseException, reason: str) -> None:
    assert reason_of(error) == reason


def test_who_survives_exceptions_does_not_survive_an_ego_that_is_gone() -> None:
    assert not issubclass(EgoGone, Exception)
