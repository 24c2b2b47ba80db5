"""Steps of the documentation site's build that its generator does not have; `make docs` runs them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import griffe
from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

ROOT = Path(__file__).parents[1]
OUTSIDE = {"NOTICE": "notice.md", "agents/data/README.md": "model_cards.md"}
"""Files outside docs/ to which pages link, and the pages that they become."""
REMOTE = re.compile(r"<(?:script|img|iframe|source)\b[^>]*\bsrc=\"?https?:|<link\b[^>]*\bstylesheet[^>]*https?:")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the files of OUTSIDE as pages."""
    for source, page in OUTSIDE.items():
        text = (ROOT / source).read_text(encoding="utf-8").replace("](../../docs/", "](")
        if not source.endswith(".md"):
            text = f"# {source.capitalize()}\n\n```text\n{text}```\n"
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Point links at the pages of OUTSIDE, and turn blocks ```math into MathML, which browsers draw without scripts."""
    for source, page in OUTSIDE.items():
        markdown = markdown.replace(f"](../{source})", f"]({page})")
    return re.sub(
        r"^```math\n(.*?)^```$",
        lambda block: f'<div class="equation">{convert(block[1], display="block")}</div>',
        markdown,
        flags=re.MULTILINE | re.DOTALL,
    )


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """Refuse a page that would load something from another host.

    Raises:
        PluginError: If there is such an element.
    """
    found = REMOTE.search(output)
    if found:
        raise PluginError(f"{page.file.src_path}: expected no remote asset, got {found[0]}; put the file under docs/.")
    return output


class ExampleSections(griffe.Extension):
    """Shows the examples of a docstring as code: the section that griffe knows is called `Examples:`."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rename the section `Example:`."""
        if obj.docstring:
            obj.docstring.value = re.sub(r"^( *)Example:$", r"\1Examples:", obj.docstring.value, flags=re.MULTILINE)
