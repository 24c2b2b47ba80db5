import json
from dataclasses import asdict, replace

from benchmarks.estimators.two_stage.repeated_seeds import SeededRun
from benchmarks.estimators.two_stage.warning_kinds import WarningKind, count_kinds, main

RUN = SeededRun("one", 0, 2, 1e-3, 1e-3, 0.8e-3, 1.2e-3, 0.1, 1000, "converged")
FAR_OFF = replace(RUN, p=0.5e-3)
ODD, COARSE = "3 of 10 runs are odd: 1.2e-04.", "The estimate is coarse."


def test_kinds_are_counted_once_a_run_and_apart_for_far_off_ones():
    runs = [RUN, replace(RUN, warnings=(ODD, ODD.replace("3", "4"))), replace(FAR_OFF, warnings=(COARSE, ODD))]
    assert count_kinds(runs) == [
        WarningKind("n of n runs are odd", 1, 1),
        WarningKind("The estimate is coarse.", 1, 0),
        WarningKind("any", 1, 1),
    ]


def test_the_table_is_of_all_files(tmp_path, capsys):
    paths = []
    for name, run in (("a", RUN), ("b", replace(FAR_OFF, warnings=(COARSE,)))):
        paths.append(tmp_path / f"{name}.jsonl")
        paths[-1].write_text(json.dumps(asdict(run)) + "\n")
    main(paths, tmp_path / "table.json")
    assert "| The estimate is coarse. | 1 | 0 |" in capsys.readouterr().out
    table = json.loads((tmp_path / "table.json").read_text())
    assert (table["about"]["runs"], table["about"]["far_off"]) == (2, 1)
    assert table["rows"][-1] == {"kind": "any", "far_off": 1, "others": 0}
