"""JUnit: trials of an ego as the XML that continuous integration shows."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

from rare_envs.files import replace_file
from rare_envs.study.corpus.trial import Trial

_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot hold."""


def write_junit(path: Path, trials: Sequence[Trial], ego: str, seconds: float) -> None:
    """Write a report of test cases, one for each stored scenario.

    Args:
        path: The file.
        trials: Of the ego.
        ego: Its name.
        seconds: Wall time of all of them [s].

    Raises:
        OSError: It cannot be written.
    """
    outcomes = [trial.outcome for trial in trials]
    counts = {
        "tests": str(len(trials)),
        "failures": str(outcomes.count("failed")),
        "errors": str(outcomes.count("error")),
        "skipped": "0",
        "time": f"{seconds:.3f}",
    }
    root = ET.Element("testsuites", {name: value for name, value in counts.items() if name != "skipped"})
    suite = ET.SubElement(root, "testsuite", {"name": _clean(f"rare-envs corpus, ego {ego}"), **counts})
    for trial in trials:
        case = ET.SubElement(
            suite,
            "testcase",
            classname=_clean(trial.failure.env_id),
            name=trial.failure.key,
            time=f"{seconds / len(trials):.3f}",
        )
        if trial.outcome != "passed":
            kind = "failure" if trial.outcome == "failed" else "error"
            element = ET.SubElement(case, kind, message=_clean(describe_trial(trial)), type=_clean(trial.crash or kind))
            element.text = _clean(describe_trial(trial))
    ET.indent(root)
    with replace_file(path) as draft:
        ET.ElementTree(root).write(draft, encoding="utf-8", xml_declaration=True)


def describe_trial(trial: Trial) -> str:
    """Return what happened, in a line."""
    if trial.outcome == "error":
        return f"the ego failed to answer: {trial.reason}"
    how = f", {trial.crash}" if trial.crash not in ("", "none") else ""
    before = f"; recorded f = {trial.failure.f:.4g} of {trial.failure.ego or 'an ego'}"
    return f"f = {trial.f:.4g} {'<=' if trial.outcome == 'failed' else '>'} {trial.failure.gamma:g}{how}{before}"


def _clean(text: str) -> str:
    return _NOT_XML.sub("?", text)
