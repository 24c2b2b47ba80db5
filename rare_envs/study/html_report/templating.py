"""Templates of pages; everything that files say is escaped."""

import re
from typing import Any

import jinja2
from markupsafe import Markup

_BROKEN_NUMBER = re.compile(r"(?<=\d) (?=%|× 10)|(?<=×) (?=10)")
"""Spaces within a number: "0.12 %", "3.1 × 10⁻⁵"."""


def keep_numbers_whole(value: object) -> object:
    """Return text without line breaks within its numbers; anything else, pictures and styles too, as it is."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    return _BROKEN_NUMBER.sub("\xa0", value)


def render_template(name: str, **values: Any) -> str:
    """Return a page."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rare_envs.study.html_report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=keep_numbers_whole,
    )
    return environment.get_template(name).render(**values)
