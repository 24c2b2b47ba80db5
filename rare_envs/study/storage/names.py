"""Names of the files in the folder of a run; `docs/run_folder.md` describes what is in them."""

STUDY = "study.json"
"""What was asked, by what command and with which versions."""
STUDY_FORMAT = 1
"""Version of the fields of study.json; see docs/run_folder.md."""
RESULT, FAILURES, BLOCKS, PLOT = "result.json", "failures.csv", "failures.npz", "plot.png"
"""Blocks are what a table has no room for: of more than `columns.MAX_SHOWN` values, drivers' weights and noise."""
EPISODES = "episodes.parquet"
"""All simulations."""
REPORT = "report.html"
SENSITIVITY = "sensitivity.png"
"""Bars of what p is sensitive to, if the question asks for it."""
SEVERITY = "severity.png"
"""P[collision with delta-v > v] over v, if there are collisions."""
FAULTS, FAULT_BLOCKS = "faults.csv", "faults.npz"
"""The same as of failures for scenarios on which the ego failed."""
RESULT_FILES = (RESULT, FAILURES, BLOCKS, PLOT, SENSITIVITY, SEVERITY, FAULTS, FAULT_BLOCKS, STUDY, EPISODES, REPORT)
