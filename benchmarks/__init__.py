"""Scripts that measure, one question each; run them as `python -m benchmarks.NAME`."""
