"""Size of the project against its budgets: lines, modules, pages, and what an estimate enters.

python -m benchmarks.size        # of the working directory; prints one table
"""

import ast
import contextlib
import io
import runpy
import sys
import tempfile
import tokenize
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np

PACKAGES = ("agents", "rare_envs", "samplers", "training")
LAYOUT = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
BUDGETS = {
    "package lines": 45_000,
    "code lines": 27_000,
    "modules": 220,
    "functions": 2_300,
    "classes": 350,
    "import lines, percent of code": 9,
    "test lines": 30_000,
    "pages": 18,
    "words of pages": 40_000,
    "files entered by an estimate": 40,
    "files entered by plain Monte Carlo": 20,
    "files entered by the command": 80,
    "own frames from estimate to f": 8,
    "own frames from the command to f": 16,
}
"""Largest values; `benchmarks.size` prints them beside what there is."""


def measure_text(root: Path) -> dict[str, float]:
    """Return the counts of lines, modules, functions, classes, pages and words under a folder."""
    paths = [path for package in PACKAGES for path in (root / package).rglob("*.py")]
    texts = [path.read_text() for path in paths]
    nodes = [node for text in texts for node in ast.walk(ast.parse(text))]
    code = sum(count_code_lines(text) for text in texts)
    imports = sum(1 + node.end_lineno - node.lineno for node in nodes if isinstance(node, ast.Import | ast.ImportFrom))
    pages = [path.read_text() for path in (root / "docs").rglob("*.md")]
    return {
        "package lines": sum(text.count("\n") for text in texts),
        "code lines": code,
        "modules": len(paths),
        "functions": sum(isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) for node in nodes),
        "classes": sum(isinstance(node, ast.ClassDef) for node in nodes),
        "import lines, percent of code": round(100 * imports / code, 1),
        "test lines": sum(path.read_text().count("\n") for path in (root / "tests").rglob("*.py")),
        "pages": len(pages),
        "words of pages": sum(len(page.split()) for page in pages),
    }


def count_code_lines(text: str) -> int:
    """Return the number of lines with code: no blank line, no comment, no docstring."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    lines = {line for each in tokens if each.type not in LAYOUT for line in range(each.start[0], each.end[0] + 1)}
    strings = [
        node
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    ]
    return len(lines.difference(*(range(node.lineno, node.end_lineno + 1) for node in strings)))


def measure_calls(root: Path) -> dict[str, float]:
    """Return how many files of ours three runs enter, and how deep f lies in them. It simulates, in this process."""
    import rare_envs
    import samplers

    problem = rare_envs.DrivingProblem("rare_envs/CutIn-v0")
    problem.evaluate(problem.base.sample(300, np.random.default_rng(0)))  # compiles what is compiled
    files, depth = trace(root, lambda: samplers.estimate(problem, seed=0))
    of_monte_carlo, _ = trace(root, lambda: samplers.estimate(problem, "mc", seed=0, max_sim=2000))
    with tempfile.TemporaryDirectory() as folder:
        of_command, depth_of_command = trace(root, lambda: run_command(f"{folder}/run"))
    return {
        "files entered by an estimate": files,
        "files entered by plain Monte Carlo": of_monte_carlo,
        "files entered by the command": of_command,
        "own frames from estimate to f": depth,
        "own frames from the command to f": depth_of_command,
    }


def trace(root: Path, run: Callable[[], Any]) -> tuple[int, int]:
    """Run a function; return the number of our files whose functions are entered, and of our frames above f.

    What a module calls while it is imported does not count.
    """
    files: set[str] = set()
    depths, importing, known = [0], [0], set[CodeType]()

    def note(frame: FrameType, event: str, argument: Any) -> None:
        code = frame.f_code
        if event not in ("call", "return") or (code in known and not importing[0]):
            return
        if code.co_name == "<module>" and not code.co_filename.endswith("__main__.py"):
            importing[0] += 1 if event == "call" else -1
        elif event == "call" and not importing[0]:
            if is_ours(root, code.co_filename):
                files.add(code.co_filename)
            if code.co_name in ("evaluate", "attempt") and code.co_filename.endswith("rare_envs/problem.py"):
                depths.append(sum(is_ours(root, each.f_code.co_filename) for each in callers(frame)))
            else:
                known.add(code)

    sys.setprofile(note)
    try:
        run()
    finally:
        sys.setprofile(None)
    return len(files), max(depths)


def is_ours(root: Path, path: str) -> bool:
    """Return whether a file belongs to one of the packages."""
    return path.startswith(tuple(f"{root / package}/" for package in PACKAGES))


def callers(frame: FrameType) -> Iterator[FrameType]:
    """Yield the frames that have called a frame."""
    while frame.f_back is not None:
        frame = frame.f_back
        yield frame


def run_command(out: str) -> None:
    """Run `rare-envs estimate` in this process."""
    words, sys.argv = sys.argv, f"rare-envs estimate rare_envs/CutIn-v0 --out {out}".split()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        with contextlib.suppress(SystemExit):
            runpy.run_module("rare_envs", run_name="__main__")
    sys.argv = words


def main() -> None:
    """Print the table."""
    root = Path.cwd()
    found = {**measure_text(root), **measure_calls(root)}
    for name, budget in BUDGETS.items():
        print(f"{name:36s} {found[name]:>9,} {budget:>9,}  {'over' if found[name] > budget else ''}")


if __name__ == "__main__":
    main()
