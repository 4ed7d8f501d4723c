"""Hooks of mkdocs: add the pages that the program writes about itself to the handbook."""

import posixpath
import re
import sys
from pathlib import Path

from mkdocs.structure.files import File

sys.path.insert(0, str(Path(__file__).parent))

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page
from reference import find_page, write_reference

from pipeline.models import list_effects

_PAGES = "docs/pages"
_NAMED = 'class="md-search" data-md-component="search" role="dialog" aria-label="Search"'


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Every effect has its place in the contents, in the order of a command's way."""
    (effects,) = (section["Effects"] for section in config.nav or [] if "Effects" in section)
    effects += [f"effects/{kind.id}.md" for kind in list_effects()]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add generated pages and notebooks; one that is written by hand as well is an error of mkdocs."""
    for path, text in write_reference().items():
        files.append(File.generated(config, path, content=text))
    for notebook in (Path(__file__).parents[2] / "examples").glob("*.ipynb"):
        text = notebook.read_text(encoding="utf-8")
        files.append(File.generated(config, f"notebooks/{notebook.name}", content=text))
    return files


def on_page_markdown(markdown: str, *, page: Page, **_: object) -> str:
    """A link to a source of the repository leads to the page that is made of it."""
    folder = posixpath.dirname(page.file.src_uri)

    def lead(link: re.Match[str]) -> str:
        found = find_page(posixpath.normpath(posixpath.join(_PAGES, folder, link[1])))
        return link[0] if found is None else f"]({posixpath.relpath(found, folder or '.')}"

    return re.sub(r"\]\((\.\./[^)#\s]+)", lead, markdown)


def on_post_page(output: str, **_: object) -> str:
    """The theme's search is a dialog without a name, which readers of screens need."""
    return output.replace('class="md-search" data-md-component="search" role="dialog"', _NAMED)
