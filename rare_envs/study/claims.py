"""Claims about a run or a risk: a tree in goal structuring notation (GSN), judged by the files that its leaves name.

Each leaf names a file, a JSON pointer into it and a rule; anybody can apply the rule to the file again (`judge_leaf`).

References:
    GSN Community Standard, version 3, 2021; RFC 6901, JSON Pointer.
"""

from __future__ import annotations

import hashlib
import io
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from rare_envs.files import open_ordinary, read_json
from rare_envs.plugins import clean_text
from rare_envs.study.run_folder import DIGESTED, EVIDENCE, RESULT, RISK, STUDY
from rare_envs.study.text import format_probability, format_rate, name_scenario

COVERAGE, UNCERTAINTY, VALIDATION = "coverage.json", "uncertainty.json", "validation.json"
TRAFFIC, TEST_CASES, ORIGIN, CLAIMS = "traffic.json", "test_cases.json", "origin.json", "claims.json"
FILES = (COVERAGE, UNCERTAINTY, VALIDATION, TRAFFIC, TEST_CASES, ORIGIN, CLAIMS)
"""Files of a run; those of a risk, a sum over scenarios, have neither traffic nor test cases of their own."""
MANIFEST = "manifest.json"
"""SHA-256 digests of all others; its own digest is to be kept elsewhere."""
DISCLAIMER = (
    "This folder documents a simulation study. It is no conformity assessment and no approval, and it does not "
    "replace the judgement of a technical service."
)
ENOUGH_COV = 0.3
"""Largest relative standard error of p at which the simulations are called enough."""
KNOWN = "known"
"""What a leaf wants of a value if it wants one at all."""


def judge_leaf(folder: Path, leaf: Mapping[str, Any]) -> str:
    """Return "supported", "not supported" or "not known" of a leaf of claims.json, from its file in the folder.

    A file whose digest is not that in manifest.json supports nothing; for test cases their own files count too. One
    that cannot be read is an OSError, one without a JSON object a ValueError.
    """
    file, value = leaf["file"], read_pointer(read_json(folder / leaf["file"]), leaf["pointer"])
    if value in (None, ""):
        return "not known"
    files = (file, f"{EVIDENCE}/test_cases/") if file.endswith(TEST_CASES) else (file,)
    right = (leaf["rule"] == KNOWN or value == leaf["limit"]) and not find_changed(folder, files)
    return "supported" if right else "not supported"


def read_pointer(content: Mapping[str, Any], pointer: str) -> Any:
    """Return the value at a JSON pointer; None if there is none.

    Example:
        >>> read_pointer({"sources": [{"limited": True}]}, "/sources/0/limited")
        True
    """
    value: Any = content
    for part in filter(None, pointer.split("/")):
        try:
            value = value[int(part)] if isinstance(value, list) else value[part]
        except (KeyError, IndexError, ValueError, TypeError):
            return None
    return value


Digests = dict[Path, str]
"""SHA-256 digests of results, which do not change while a report is made; what is written with it is not among them."""


def find_changed(folder: Path, files: tuple[str, ...] = ("",), known: Digests | None = None) -> list[str]:
    """Return the files of a run, a risk and their evidence that manifest.json has otherwise.

    They are relative to the folder; `files` are the beginnings of those that are looked at.
    """
    known = {} if known is None else known
    filed, found = (
        read_json(folder / EVIDENCE / MANIFEST).get("sha256") or {},
        digest_files(folder, files, known),
    )
    names = {name for name in (*filed, *found) if name.startswith(files)}
    return sorted(name for name in names if found.get(name) != filed.get(name))


def digest_files(folder: Path, files: tuple[str, ...], known: Digests) -> dict[str, str]:
    """Return SHA-256 digests of the results of a run, or of a risk and its runs, and of the evidence in its folder."""
    digests, own = dict[str, str](), folder / EVIDENCE / MANIFEST
    results = [each / name for each in (folder, *list_runs(folder)) for name in (RISK, STUDY, *DIGESTED)]
    filed = [path for each in (folder, *list_runs(folder)) for path in (each / EVIDENCE).rglob("*")]
    for path in sorted((*results, *filed)):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and path != own and name.startswith(files):
            digests[name] = known.get(path) or digest_file(path)
            if path in results:
                known[path] = digests[name]
    return digests


def digest_file(path: Path) -> str:
    """Return the SHA-256 digest of an ordinary file of any size."""
    digest = hashlib.sha256()
    with open_ordinary(path) as file:
        while part := file.read(1 << 20):
            digest.update(part)
    return digest.hexdigest()


def list_runs(folder: Path) -> list[Path]:
    """Return the folders of the runs of a risk; none if it is none."""
    names = [*map(str, read_json(folder / RISK).get("scenarios") or ())] if (folder / RISK).is_file() else []
    for name in names:
        if Path(name).name != name or (folder / name).resolve().parent != folder.resolve():
            raise ValueError(f"Expected names of folders in {str(folder)!r} as scenarios of its {RISK}, got {name!r}.")
    return [folder / name for name in names]


Goals = dict[str, list[tuple[str, str, str, Any]]]
"""By strategy its claims: text, file, pointer into it, and the value there that supports it, or `KNOWN`."""


def build_claims(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the nodes of the claim tree of a run, parents first."""
    few = f"Enough simulations in each part of the traffic: relative error of p at most {ENOUGH_COV:g}"
    people = "A human driver model is within a factor 3 of people's interval"
    events, goals = enumerate(result.get("events") or []), Goals()
    goals["S1 Argue over each source of uncertainty"] = [
        *([("The limit is met", RESULT, "/gate/decision", "passes")] if result.get("gate") else []),
        (few, UNCERTAINTY, "/simulations/enough", True),
        ("Recorded events limit p", UNCERTAINTY, "/sources/2/limited", True),
        *((f"{people} ({one['event']})", UNCERTAINTY, f"/calibration/{n}/calibrated", True) for n, one in events),
    ]
    goals["S2 Argue over the tool chain"] = [
        ("Failures replay", VALIDATION, "/replays/differing", 0),
        ("Two implementations of one model agree", VALIDATION, "/simulators/failures_differing", 0),
        ("The traffic model expects what was recorded", TRAFFIC, "/checks_outside", 0),
        ("The run has no warning", VALIDATION, "/warnings", []),
    ]
    goals["S3 Argue over what is filed"] = [
        ("The result is what its method makes of its simulations", VALIDATION, "/computed_again/differing", []),
        ("Each crash mode has a test case", TEST_CASES, "/modes_without_case", 0),
        ("The run can be made again", ORIGIN, "/command", KNOWN),
        ("The files are those that the run wrote", VALIDATION, "/files_changed", []),
    ]
    return _list_nodes(_describe_limit(result), goals)


def build_claims_of_sum(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the nodes of the claim tree of a risk, a sum over scenarios, whose runs have trees of their own."""
    goals, gate, limit = Goals(), result["gate"], "Upper limit {} collisions per million km".format
    goals["S1 Argue over each scenario, by the claims of its run"] = [
        (
            f"{limit(format_rate(part['interval_per_million_km'][1]))} in {name_scenario(name)}",
            *(f"{name}/{EVIDENCE}/{CLAIMS}", "/nodes/0/status", "supported"),
        )
        for name, part in result["scenarios"].items()
    ]
    goals["S2 Argue over the sum"] = [
        *([("The limit is met", RISK, "/gate/decision", "passes")] if gate else []),
        ("No scenario that was asked for is left out", COVERAGE, "/left_out", {}),
        ("Recorded events limit each rate", UNCERTAINTY, "/limited", True),
        ("The sum is that of its runs", VALIDATION, "/computed_again/differing", []),
        ("The files are those that were filed", VALIDATION, "/changed", []),
        ("The risk can be made again", ORIGIN, "/command", KNOWN),
    ]
    about = f"{result['ego']} in {' and '.join(map(name_scenario, result['scenarios']))}"
    about += f", {100 * result['confidence']:g} %"
    whole = limit(format_rate(result["interval_per_million_km"][1]))
    return _list_nodes(f"{whole}; {_describe_gate(gate)} ({about})", goals)


def _list_nodes(top: str, goals: Goals) -> list[dict[str, Any]]:
    """Return the nodes of a tree: the top claim, its context, and by strategy its claims, each with its leaf."""
    nodes: list[dict[str, Any]] = [
        {"id": "G1", "kind": "goal", "text": top, "supports": None},
        {"id": "C1", "kind": "context", "text": f"Covered: {EVIDENCE}/{COVERAGE}", "supports": "G1"},
        {"id": "A1", "kind": "assumption", "text": "The family of the traffic model is right", "supports": "G1"},
    ]
    for strategy, below in goals.items():
        own, _, words = strategy.partition(" ")
        nodes.append({"id": own, "kind": "strategy", "text": words, "supports": "G1"})
        for claim, name, pointer, limit in below:
            number = sum(node["kind"] == "goal" for node in nodes) + 1
            nodes.append({"id": f"G{number}", "kind": "goal", "text": claim, "supports": own})
            file, rule = f"{EVIDENCE}/{name}" if name in FILES else name, KNOWN if limit is KNOWN else "equals"
            text = f"{file} {pointer}: {rule}" + ("" if limit is KNOWN else f" {limit!r}")
            leaf = {"file": file, "pointer": pointer, "rule": rule, "limit": None if limit is KNOWN else limit}
            nodes.append({"id": f"Sn{number}", "kind": "solution", "supports": f"G{number}", "text": text, **leaf})
    return nodes


def _describe_limit(result: Mapping[str, Any]) -> str:
    """Return what the top claim says: the widest upper limit of a run, and what a gate decided of it."""
    question, rate, traffic = result["question"], result.get("rate"), result.get("base_uncertainty") or {}
    ends = (result["interval"][1], (traffic.get("interval") or [None, None])[1], traffic.get("bound"))
    high = max(float(end) for end in ends if end is not None)
    limit = f"Upper limit {format_probability(high)} per scenario"
    if rate is not None:
        limit = f"Upper limit {format_rate(rate['interval_per_million_km'][1])} per million km"
    about = f"{question['ego']} in {question['env_id']}, {100 * result['confidence']:g} %"
    return f"{limit if high < 1 else 'No upper limit'}; {_describe_gate(result.get('gate'))} ({about})"


def _describe_gate(gate: Mapping[str, Any] | None) -> str:
    """Return what was decided of a limit."""
    return f"limit {gate['limit']:g} {gate['quantity']}: {gate['decision']}" if gate else "no acceptance limit was set"


def judge_claims(folder: Path, nodes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the tree with the status of each node: of leaves by their files, of the others by what is below them."""
    status: dict[str, str] = {}
    for node in reversed(nodes):
        below = [status[each["id"]] for each in nodes if each["supports"] == node["id"] and each["id"] in status]
        if node["kind"] == "solution":
            status[node["id"]] = judge_leaf(folder, node)
        elif below:
            worst = [each for each in ("not supported", "not known") if each in below]
            status[node["id"]] = worst[0] if worst else "supported"
    return {
        "notation": "GSN Community Standard 3",
        "disclaimer": DISCLAIMER,
        "nodes": [{**node, "status": status.get(node["id"])} for node in nodes],
    }


COLOURS = {"supported": "#dff0e2", "not supported": "#f6d9d5", "not known": "#f5ecd2", None: "#eef1f5"}
"""Fill of a node by its status."""


def draw_claims(nodes: Sequence[Mapping[str, Any]]) -> str:
    """Return the claim tree as SVG: a row for each goal with its leaf, below its strategy."""
    rows = [node for node in nodes if node["kind"] != "solution"]
    leaves = {node["supports"]: node for node in nodes if node["kind"] == "solution"}
    figure = Figure(figsize=(11.0, 0.62 * len(rows) + 0.4))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0, 11.0), ylim=(-len(rows) + 0.2, 0.9))
    axes.axis("off")
    place: dict[str, tuple[float, float]] = {}
    for number, node in enumerate(rows):
        depth = {"G1": 0.0}.get(node["id"], 0.5 if node["kind"] != "goal" else 1.0)
        place[node["id"]] = depth + 0.1, -float(number)
        if node["supports"]:
            x, y = place[node["supports"]]
            axes.plot((x + 0.1, x + 0.1, depth + 0.1), (y - 0.25, -number, -number), color="#5b6675", linewidth=0.8)
        _draw_node(axes, node, depth + 0.1, -number, 5.4)
        if node["id"] in leaves:
            axes.plot((depth + 0.1, 6.6), (-number, -number), color="#5b6675", linewidth=0.8)
            _draw_node(axes, leaves[node["id"]], 6.6, -number, 4.2)
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def _draw_node(axes: Any, node: Mapping[str, Any], x: float, y: float, width: float) -> None:
    """Draw a node: a box with its id, text and status; a leaf has round ends, as in GSN."""
    style = "round4" if node["kind"] == "solution" else "square"
    below = "" if node["supports"] else "all below: "
    mark = f"{node['id']}  {node['text']}" + (f"  [{below}{node['status']}]" if node.get("status") else "")
    text = textwrap.fill(clean_text(mark), int(width * 13.5))
    axes.text(
        *(x + 0.06, y, text),
        va="center",
        fontsize=9,
        parse_math=False,
        bbox={"boxstyle": f"{style},pad=0.35", "facecolor": COLOURS[node.get("status")], "edgecolor": "#5b6675"},
    )
