"""Study: one evaluation as a user runs it, from a question to a report, its folder and its pictures.

The names are imported when they are used, so that the command line starts without torch.
"""

from typing import TYPE_CHECKING

from rare_envs.plugins import make_lazy_getattr

if TYPE_CHECKING:
    from rare_envs.study.arguments import BadInput, Question
    from rare_envs.study.evaluate import run, run_into
    from rare_envs.study.failures import severity_curve
    from rare_envs.study.plots import write_film
    from rare_envs.study.question import prepare
    from rare_envs.study.replay import Drive, drive_again
    from rare_envs.study.report import Report
    from rare_envs.study.run_folder import read_failures
    from rare_envs.study.writing import write_run

__all__ = [
    "BadInput",
    "Drive",
    "Question",
    "Report",
    "drive_again",
    "prepare",
    "read_failures",
    "run",
    "run_into",
    "severity_curve",
    "write_film",
    "write_run",
]

_MODULES = {
    "arguments": ("BadInput", "Question"),
    "evaluate": ("run", "run_into"),
    "failures": ("severity_curve",),
    "question": ("prepare",),
    "replay": ("Drive", "drive_again"),
    "report": ("Report",),
    "run_folder": ("read_failures",),
    "plots": ("write_film",),
    "writing": ("write_run",),
}

__getattr__ = make_lazy_getattr(
    __name__, {name: f"{__name__}.{module}" for module, names in _MODULES.items() for name in names}
)
