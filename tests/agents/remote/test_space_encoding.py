"""Spaces survive the journey, and malformed ones are refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from agents.remote import protocol
from agents.remote.space_encoding import decode_space, encode_space


def test_spaces_survive_the_journey_and_lies_do_not() -> None:
    uneven = spaces.Box(np.array([0.0, -np.inf], np.float32), np.array([1.0, 2.0], np.float32))
    shapes = spaces.Box(-5.0, 5.0, (3, 3)), uneven
    image = spaces.Box(0, 255, (36, 64, 3), np.uint8)
    for space in (*shapes, image, spaces.Discrete(5), spaces.Dict({"camera": image, "lidar": shapes[0]})):
        described = protocol.unpack(protocol.pack({"space": encode_space(space)}))["space"]
        assert decode_space(described) == space
        assert len(str(described)) < 300
    assert decode_space({"shape": [2]}) == spaces.Box(-np.inf, np.inf, (2,))
    box: dict[str, Any] = {"shape": [2], "low": [0.0, 0.0], "high": 1.0}
    wrong: list[Any] = [7, "box", [], {}, {"n": 0}, {"n": -1}, {"n": True}, {"n": 1e9}, {"parts": []}]
    wrong += [{"parts": {"a": {"parts": {"b": {"n": 2}}}}}, {"parts": {"a": 3}}]
    wrong += [{**box, "shape": shape} for shape in ([-2], [2**40], [2**12, 2**12], "2", [[2]], [1.5])]
    wrong += [{**box, "low": low} for low in ([0.0] * 3, "zero", float("nan"), 2.0, {}, [[0.0], [0.0, 1.0]])]
    for given in wrong:
        with pytest.raises(protocol.MalformedMessage, match="a space"):
            decode_space(given)
