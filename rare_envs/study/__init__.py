"""Study: one evaluation as a user runs it, from a question to a report, its folder and its pictures.

The names are imported when they are used, so that the command line starts without torch.
"""

from typing import TYPE_CHECKING

from rare_envs.plugins import make_lazy_getattr

if TYPE_CHECKING:
    from rare_envs.study.arguments import Question
    from rare_envs.study.compare import EgoComparison, compare_egos
    from rare_envs.study.errors import BadInput
    from rare_envs.study.evaluate import resume, run, run_into
    from rare_envs.study.question import Study, prepare
    from rare_envs.study.replay import Drive, drive_again
    from rare_envs.study.report import Report
    from rare_envs.study.run_folder import LoadedStudy, load_study, read_failures
    from rare_envs.study.severity import Severity, severity_curve
    from rare_envs.study.video import write_film
    from rare_envs.study.writing import write_run

__all__ = [
    "BadInput",
    "Drive",
    "EgoComparison",
    "LoadedStudy",
    "Question",
    "Report",
    "Severity",
    "Study",
    "compare_egos",
    "drive_again",
    "load_study",
    "prepare",
    "read_failures",
    "resume",
    "run",
    "run_into",
    "severity_curve",
    "write_film",
    "write_run",
]

_LAZY = {
    "BadInput": "rare_envs.study.errors",
    "Drive": "rare_envs.study.replay",
    "EgoComparison": "rare_envs.study.compare",
    "LoadedStudy": "rare_envs.study.run_folder",
    "Question": "rare_envs.study.arguments",
    "Report": "rare_envs.study.report",
    "Severity": "rare_envs.study.severity",
    "Study": "rare_envs.study.question",
    "compare_egos": "rare_envs.study.compare",
    "drive_again": "rare_envs.study.replay",
    "load_study": "rare_envs.study.run_folder",
    "prepare": "rare_envs.study.question",
    "read_failures": "rare_envs.study.run_folder",
    "resume": "rare_envs.study.evaluate",
    "run": "rare_envs.study.evaluate",
    "run_into": "rare_envs.study.evaluate",
    "severity_curve": "rare_envs.study.severity",
    "write_film": "rare_envs.study.video",
    "write_run": "rare_envs.study.writing",
}

__getattr__ = make_lazy_getattr(__name__, _LAZY)
