import json
import math

import numpy as np
import pytest

from samplers.stored import to_json_value


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (math.nan, None),
        (-math.inf, None),
        (np.float32("inf"), None),
        (np.float64(0.25), 0.25),
        (np.int64(3), 3),
        (np.bool_(True), True),
        ("nan", "nan"),
        (None, None),
        ((1, [math.inf, {"a": (np.nan, "b")}]), [1, [None, {"a": [None, "b"]}]]),
    ],
    ids=repr,
)
def test_values_are_those_of_json(value, expected):
    found = to_json_value(value)
    assert found == expected
    assert type(found) is type(expected)
    assert json.loads(json.dumps(found, allow_nan=False)) == expected
