"""Presentation: results as HTML, as tables of points and in files."""

from samplers.presentation.curve_display import CurveDisplay
from samplers.presentation.notebook_html import html_table
from samplers.presentation.object_file import read_object, register_stored, write_object
from samplers.presentation.point_table import PointColumns, arrow_table
from samplers.presentation.stored_method import StoredMethod

__all__ = [
    "CurveDisplay",
    "PointColumns",
    "StoredMethod",
    "arrow_table",
    "html_table",
    "read_object",
    "register_stored",
    "write_object",
]
