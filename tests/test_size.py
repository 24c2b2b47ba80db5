"""The size of the project stays within limits; `python -m benchmarks.size` prints it beside the budgets."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.size import BUDGETS, measure_text

ROOT = Path(__file__).parents[1]
LIMITS = {
    "package lines": 57_770,
    "code lines": 36_740,
    "modules": 215,
    "functions": 3_215,
    "classes": 472,
    "import lines, percent of code": 10.5,
    "test lines": 33_830,
    "pages": 18,
    "words of pages": 37_180,
    "files entered by an estimate": 43,
    "files entered by plain Monte Carlo": 20,
    "files entered by the command": 87,
    "own frames from estimate to f": 8,
    "own frames from the command to f": 16,
}
"""What must not grow; the aims are `benchmarks.size.BUDGETS`."""


@pytest.fixture(scope="module")
def entered() -> dict[str, float]:
    """What runs enter, in a process that has imported and kept nothing."""
    code = (
        "import json, pathlib; from benchmarks.size import measure_calls;"
        "print(json.dumps(measure_calls(pathlib.Path.cwd())))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_all_budgets_have_limits() -> None:
    assert list(LIMITS) == list(BUDGETS)


def test_lines_and_pages_stay_within_their_limits() -> None:
    assert not over(measure_text(ROOT))


def test_calls_stay_within_their_limits(entered: dict[str, float]) -> None:
    assert min(entered.values()) > 0 and not over(entered)


def over(found: dict[str, float]) -> dict[str, float]:
    """Return what is above its limit."""
    return {name: value for name, value in found.items() if value > LIMITS[name]}
