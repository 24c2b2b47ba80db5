"""Scenarios of the tests of remote egos."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("zmq", reason="the extra remote is optional")
pytest.importorskip("msgpack", reason="the extra remote is optional")
from tests.agents.remote.egos import Braking, problem


@pytest.fixture(scope="module")
def x() -> np.ndarray:
    return problem(Braking()).base.sample(40, np.random.default_rng(0))
