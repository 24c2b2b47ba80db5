"""JUnit: the counts are those of the cases, whatever an ego's error says."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

from rare_envs.study.corpus import StoredFailure, Trial, write_junit


def test_cases_and_counts(tmp_path: Path) -> None:
    one = StoredFailure("rare_envs/CutIn-v0", {"gamma": 0.0}, {"x": [1.0]}, -1.0, 0.0, "idm")
    trials = [
        Trial(one, "passed", 1.5),
        Trial(one, "failed", -1.0, "side"),
        Trial(one, "error", math.nan, reason="<&\x00\x1b]]> \ud800 no answer"),
    ]
    write_junit(tmp_path / "out.xml", trials, "a & b", 3.0)
    root = ET.parse(tmp_path / "out.xml").getroot()
    suite = root[0]
    assert root.tag == "testsuites" and suite.tag == "testsuite" and suite.get("name") == "rare-envs corpus, ego a & b"
    cases = suite.findall("testcase")
    for counted in (root, suite):
        assert (counted.get("tests"), counted.get("failures"), counted.get("errors")) == ("3", "1", "1")
    assert [[child.tag for child in case] for case in cases] == [[], ["failure"], ["error"]]
    assert all(case.get("name") == one.key and case.get("classname") == "rare_envs/CutIn-v0" for case in cases)
    assert sum(float(str(case.get("time"))) for case in cases) == 3.0
    assert "no answer" in str(cases[2][0].get("message")) and cases[1][0].get("type") == "side"
