import json

import pytest

from benchmarks.estimators.few_simulations.study import main

SET = """
def make():
    return {"half": (lambda u: 1.0 - u[:, 0], 2, 0.158655), "other": (lambda u: 2.0 - u[:, 0], 3, 0.02275)}
"""


def test_runs_are_kept_by_budget_and_method_and_not_made_again(tmp_path, capsys):
    path, runs, table = (tmp_path / name for name in ("states.py", "runs.jsonl", "table.json"))
    path.write_text(SET)
    arguments = {"sets": [path], "problems": "half", "runs": runs, "json_path": table}
    main(budgets="100", seeds="2", methods="mc", **arguments)
    first = runs.read_text()
    main(budgets="50,100", seeds="1,3", methods="mc,ss", **arguments)
    assert runs.read_text().startswith(first)
    made = [(row["method"], row["max_sim"], row["seed"]) for row in map(json.loads, runs.read_text().splitlines())]
    expected = {(method, n, seed) for method in ("mc", "ss") for n, k in ((50, 1), (100, 3)) for seed in range(k)}
    assert len(made) == len(set(made)) == 8
    assert set(made) == expected
    rows = json.loads(table.read_text())["rows"]
    assert [(row["method"], row["max_sim"], row["runs"]) for row in rows] == [
        ("mc", 50, 1),
        ("ss", 50, 1),
        ("mc", 100, 3),
        ("ss", 100, 3),
    ]
    assert capsys.readouterr().out.count("| half | 2 |") == 5
    before = runs.read_text()
    main(budgets="50,100", seeds="9,9", methods="mc", made=True, **{**arguments, "problems": ""})
    assert runs.read_text() == before
    assert [(row["max_sim"], row["runs"]) for row in json.loads(table.read_text())["rows"]] == [(50, 1), (100, 3)]


def test_a_budget_without_its_number_of_seeds_is_an_error():
    with pytest.raises(ValueError, match="zip"):
        main(budgets="100,300", seeds="2")
