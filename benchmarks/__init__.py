"""Benchmarks: scripts that measure, one question each; run them as `python -m benchmarks.FOLDER.NAME`."""

from pathlib import Path

RESULTS = Path(__file__).parent / "results"
"""Folder of the committed results, where the scripts write by default."""
