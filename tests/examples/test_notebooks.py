"""The notebooks run as they stand; here with smaller settings than those they show."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path
from typing import Any

import matplotlib
import pytest

from rare_envs.startup import use_one_thread

FOLDER = Path(__file__).parents[2] / "examples" / "notebooks"
SMALL: dict[str, dict[str, Any]] = {
    "samplers_without_cars": {"MAX_SIM": 1_200},
    "train_and_estimate": {"STEPS": 8_192, "MAX_SIM": 1_500},
    "your_own_data": {"EVENTS": 40, "REFITS": 5, "MAX_SIM": 1_500},
    "your_own_ego": {"MAX_SIM": 1_500},
}
"""What the cell of settings is followed by, for each notebook."""
SHOWN = {
    "samplers_without_cars": ("P[f <= 0] ", "two-stage  p =", "importance (relative entropy"),
    "train_and_estimate": ("P[f <= 0] ", "collide: p in"),
    "your_own_data": ("40 cut-ins", "collisions per million km", "40 + 40 events"),
    "your_own_ego": ("P[f <= 0] ", "Ratio        A fails ", " 0.1 ", " 1e-06 "),
}
"""Some of what they print."""


def cells_of(name: str) -> list[dict[str, Any]]:
    return list(json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"])


def code_of(cell: dict[str, Any]) -> str:
    return "".join(cell["source"])


def test_every_notebook_is_tested() -> None:
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == set(SMALL) == set(SHOWN)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (number > 0)) for number, name in enumerate(sorted(SMALL))]
)
@use_one_thread()
def test_a_notebook_runs(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(FOLDER.parents[1]))
    namespace: dict[str, Any] = {"__name__": "__main__"}
    for number, cell in enumerate(cells_of(name)):
        if cell["cell_type"] == "code":
            exec(compile(code_of(cell), f"{name}, cell {number}", "exec"), namespace)
            if "parameters" in cell["metadata"].get("tags", ()):  # the settings of SMALL after the cell that has them
                assert set(SMALL[name]) <= set(namespace)
                namespace.update(SMALL[name])
    printed = capfd.readouterr().out
    assert [text for text in SHOWN[name] if text not in printed] == []


@pytest.mark.parametrize("name", sorted(SMALL))
def test_a_notebook_is_well_formed_and_needs_nothing_of_this_machine(name: str) -> None:
    """A hosted service has the file of the notebook alone: no path outside its working directory, no data beside it."""
    cells = cells_of(name)
    code = [code_of(cell) for cell in cells if cell["cell_type"] == "code"]
    assert re.findall(r"""["'](?:/|~|\.\./|[A-Za-z]:\\\\)""", "\n".join(map(code_of, cells))) == []
    assert len((FOLDER / f"{name}.ipynb").read_bytes()) < 20_000  # no data, no pictures
    source = re.search(r'^SOURCE = "(.*)"$', code[0], re.MULTILINE)
    needed = {"samplers_without_cars": "rare-envs"}.get(name, "rare-envs[driving]")
    assert source is not None and source[1] == needed
    assert '"pip", "install"' in code[0] and "find_spec" in code[0]
    assert cells[0]["cell_type"] == "markdown"
    assert all(compile(text, name, "exec") for text in code)
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in cells if cell["cell_type"] == "code")
    assert sum("parameters" in cell["metadata"].get("tags", ()) for cell in cells) == 1
    imported = set(re.findall(r"^(?:import|from) ([a-z0-9_]+)", "\n".join(code), re.MULTILINE))
    assert {"samplers", "rare_envs"} & imported
    assert all(importlib.util.find_spec(module) for module in imported)
