from pathlib import Path

import pytest

from agents.missing_file import report_missing_file


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("eg.zip", "; in that folder: ego.zip."),
        ("policy_of_the_third_training.onnx", "; in that folder: a.onnx, b.onnx, c.onnx."),
        ("ego.safetensors", " has no .safetensors."),
        ("there/ego.zip", "there' does not exist."),
    ],
)
def test_what_stands_beside_a_missing_file_is_named(name: str, hint: str, tmp_path: Path) -> None:
    for other in ("ego.zip", "a.onnx", "b.onnx", "c.onnx", "d.onnx"):
        (tmp_path / other).touch()
    error = report_missing_file(tmp_path / name)
    assert isinstance(error, FileNotFoundError)
    assert str(error).startswith(f"No ego at '{tmp_path / name}'")
    assert str(error).endswith(hint)
