"""Report of a run as one HTML file, which needs nothing else: no network, no other file, no script."""

from typing import TYPE_CHECKING

from rare_envs.plugins import make_lazy_getattr

if TYPE_CHECKING:
    from rare_envs.study.html_report.page import write_html_report

__all__ = ["write_html_report"]

_LAZY = {"write_html_report": "rare_envs.study.html_report.page"}

__getattr__ = make_lazy_getattr(__name__, _LAZY)
