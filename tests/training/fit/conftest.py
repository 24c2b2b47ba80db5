"""Fits of few starts."""

import pytest

from training.fit import mixture


@pytest.fixture
def quick(monkeypatch):
    """Fewer starts: enough for well separated clusters."""
    monkeypatch.setattr(mixture, "EM_STARTS", 1)
