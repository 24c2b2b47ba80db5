"""The code and the commands on every page run as they stand, block after block, and print what the page shows.

What a ```python block prints stands in the ```text block that follows it; a block that prints nothing has none. One
that begins with `# NAME.py` is saved under that name too. In a ```console block lines that begin with `$` are commands,
each in a process of its own, and the lines below one are its output. All run in one new folder,
the first pages in the same one, and a command that two of them show runs once.

`...` stands for any text. Numbers with a decimal point or an exponent are compared to the digits shown, so a page shows
as many as are the same on every machine. The rest is compared character by character, apart from the width of white
space. Training differs between processors: it is cut to a few steps here, and what a command says of a trained ego is
compared by the first word of each line.
"""

import contextlib
import io
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import pytest

import rare_envs
from rare_envs.scenarios.registry import SCENARIOS
from rare_envs.startup import use_one_thread

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
NUMBER = r"[-+]?(?:\d+\.\d*|\.\d+|\d+(?=[eE][-+]?\d))(?:[eE][-+]?\d+)?"


class Block(NamedTuple):
    """A block of Python or a command, and the text shown after it ("" if there is none)."""

    code: str
    output: str
    is_command: bool = False


def blocks(page: str) -> list[Block]:
    fences = re.findall(r"^```(\w*)\n(.*?)^```$", page, flags=re.MULTILINE | re.DOTALL)
    found = []
    for (language, code), (kind, after) in zip(fences, [*fences[1:], ("", "")], strict=False):
        if language == "python":
            found.append(Block(code, after if kind == "text" else ""))
        elif language == "console":
            commands = re.findall(r"^\$ ((?:.*\\\n)*.*\n)((?:(?!\$ ).*\n)*)", code, flags=re.MULTILINE)
            found += [Block(command.partition("  #")[0].strip(), text, is_command=True) for command, text in commands]
    return found


CHANGE_THE_MACHINE = ("git ", "make ", "pip ", "python -m pip ")
"""Beginnings of commands that a page may show and that do not run here."""


def run_command(command: str) -> str:
    """Run a command as a terminal of 76 columns does; return its output."""
    environment = {**os.environ, "COLUMNS": "76", "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    shortened = re.sub(r"--steps \S+", "--steps 40000", command)
    done = subprocess.run(["bash", "-c", shortened], env=environment, capture_output=True, text=True)
    assert done.returncode in (0, 3), f"{command}\n{done.stdout}{done.stderr}"  # 3: done, with a warning
    return done.stdout


def run_python(code: str, name: str, namespace: dict[str, object]) -> str:
    """Run a block of Python; return what it prints."""
    saved = re.match(r"# (\w+\.py)\n", code)
    if saved:
        Path(saved[1]).write_text(code)
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(code, name, "exec"), namespace)
    return printed.getvalue()


def same_output(block: Block, printed: str) -> bool:
    """Return whether a block has printed what the page shows."""
    if block.is_command and ".zip" in block.code:
        return same_text(first_words(block.output), first_words(printed))
    return same_text(block.output, printed)


def first_words(text: str) -> str:
    """Return the first word of each line that does not continue another."""
    return " ".join(re.findall(r"^\S+", text, flags=re.MULTILINE))


def digit_place(number: str) -> float:
    """Return the worth of the last digit shown: 0.01 of "3.14", 1e-6 of "2.33e-04"."""
    mantissa, _, exponent = number.lower().partition("e")
    return 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))


def same_text(shown: str, printed: str) -> bool:
    """Return whether the printed text is the one that a page shows: see the module's docstring."""
    parts = re.split(rf"({NUMBER}|\.\.\.|\s+)", _without_padding(shown))
    patterns = {"...": r"[\s\S]*?"}
    pattern, numbers = "", []
    for part in parts:
        if re.fullmatch(NUMBER, part):
            pattern += rf"({NUMBER}|[-+]?\d+)"
            numbers.append(part)
        elif part.isspace():
            pattern += r"\s+"
        else:
            pattern += patterns.get(part, re.escape(part))
    match = re.fullmatch(pattern, _without_padding(printed))
    return match is not None and all(
        abs(float(got) - float(want)) <= 0.5001 * digit_place(want)
        for got, want in zip(match.groups(), numbers, strict=True)
    )


def _without_padding(text: str) -> str:
    """Return the text without the white space at its ends and inside brackets, with which NumPy fills columns."""
    return re.sub(r"(?<=[\[(])\s+|\s+(?=[\])])", "", text.strip())


QUICK = ("README.md", "first_hour.md", "meaning.md")
"""The first pages, whose code runs by default."""


@pytest.fixture(scope="module")
def first_folder(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """The folder of the first pages, and what commands have printed in it."""
    return tmp_path_factory.mktemp("first"), {}


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, id=page.name, marks=[] if page.name in QUICK else pytest.mark.slow) for page in PAGES],
)
@use_one_thread()
def test_code_of_a_page(
    page: Path, tmp_path: Path, first_folder: tuple[Path, dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    if page.name == "measures.md":
        pytest.importorskip("rtamt", reason="rtamt, for temporal logic, runs on Python 3.11 or older")
    folder, said = first_folder if page.name in QUICK else (tmp_path, {})
    monkeypatch.chdir(folder)
    code = blocks(page.read_text(encoding="utf-8"))
    assert code
    known = set(rare_envs.ENV_IDS)
    namespace: dict[str, object] = {"__name__": "__main__"}
    wrong = []
    for number, block in enumerate(each for each in code if not each.code.startswith(CHANGE_THE_MACHINE)):
        name = f"{page.name}, block {number}"
        if block.is_command:
            printed = said[block.code] if block.code in said else said.setdefault(block.code, run_command(block.code))
        else:
            printed = run_python(block.code, name, namespace)
        if not same_output(block, printed):
            wrong.append(f"{name}\n{block.code}\nprints\n{printed}where the page shows\n{block.output}")
    for env_id in set(rare_envs.ENV_IDS) - known:  # a page's own scenarios are not there for other tests
        del SCENARIOS[env_id]
        del gym.registry[env_id]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_training_on_a_page_is_seeded(page: Path) -> None:
    for block in blocks(page.read_text(encoding="utf-8")):
        for model in re.findall(r"= (?:PPO|DQN|SAC)\((.*?)\.learn\(", block.code, flags=re.DOTALL):
            assert "seed=" in model, f"two runs of the page train two policies: {model}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_code_and_output_of_a_page_need_no_scrolling(page: Path) -> None:
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    assert not [line for kind, block in fenced if kind != "math" for line in block.splitlines() if len(line) > 75]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_of_a_page(page: Path) -> None:
    for target, _, heading in re.findall(r"\]\(([^)#]*)(#([^)]*))?\)", page.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            file = page.parent / target if target else page
            assert file.exists(), target
            assert not heading or heading in headings(file.read_text(encoding="utf-8")), f"{target}#{heading}"


def headings(page: str) -> set[str]:
    """Return the headings of a page as links name them."""
    text = re.sub(r"^```.*?^```", "", page, flags=re.DOTALL | re.MULTILINE)
    found = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in found}


def test_only_the_next_text_block_is_the_output() -> None:
    fences = [("python", "a"), ("text", "1"), ("python", "b"), ("python", "c"), ("", "d"), ("text", "2")]
    fences += [("console", "$ e  # why\n3\n\n4\n$ f \\\n    g\n$ h"), ("text", "5")]
    page = "\n".join(f"```{language}\n{content}\n```\n" for language, content in fences)
    python = [("a\n", "1\n", False), ("b\n", "", False), ("c\n", "", False)]
    assert blocks(page) == [*python, ("e", "3\n\n4\n", True), ("f \\\n    g", "", True), ("h", "", True)]


@pytest.mark.parametrize(
    ("shown", "printed"),
    [
        ("", "0.5\n"),
        ("0.5", ""),
        ("p = 2.301e-04, 694 draws", "p = 2.329e-04, 694 draws"),
        ("p = 2.329e-04, 693 draws", "p = 2.329e-04, 694 draws"),
        ("0.12", "0.1251"),
        ("1.0", "-1.0"),
        ("first\n...\nlast", "first\none\ntwo"),
    ],
)
def test_other_text_is_told_apart(shown: str, printed: str) -> None:
    assert not same_text(shown, printed)
