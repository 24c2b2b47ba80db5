"""Templates of pages; everything that files say is escaped."""

from typing import Any

import jinja2


def render_template(name: str, **values: Any) -> str:
    """Return a page.

    Args:
        name: File among the templates.
        **values: What the template names.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rare_envs.study.html_report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name).render(**values)
