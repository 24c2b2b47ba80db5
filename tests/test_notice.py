"""The notice names every data file that a wheel ships, with the licence that the file itself states."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SHIPPED = sorted([*ROOT.glob("rare_envs/data/*.json"), *ROOT.glob("agents/data/*.safetensors")])
SHARE_ALIKE = "CC BY-SA 3.0"


def stated(path: Path) -> str:
    """Return what a file says of itself."""
    if path.suffix == ".json":
        return json.dumps(json.loads(path.read_text(encoding="utf-8")).get("provenance", {}))
    with path.open("rb") as file:
        (length,) = struct.unpack("<Q", file.read(8))
        return json.dumps(json.loads(file.read(length))["__metadata__"])


def section_of(path: Path) -> str:
    """Return the section of the notice that names a file."""
    name = path.relative_to(ROOT).as_posix()
    sections = (ROOT / "NOTICE").read_text(encoding="utf-8").split("\n\n")
    return next((section for section in sections if f"  {name}\n" in section), "")


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_a_shipped_file_is_named_with_its_licence(path: Path) -> None:
    section = section_of(path)
    assert section, f"NOTICE does not name {path.name}"
    assert (SHARE_ALIKE in section) == (SHARE_ALIKE in stated(path)), section


def test_the_notice_names_no_file_that_is_not_shipped() -> None:
    lines = (ROOT / "NOTICE").read_text(encoding="utf-8").splitlines()
    names = [line.strip() for line in lines if line.startswith(("  rare_envs/", "  agents/"))]
    assert len(names) == len(SHIPPED)
    assert all((ROOT / name).exists() for name in names)
