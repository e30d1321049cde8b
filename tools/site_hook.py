"""What `mkdocs build` needs beyond mkdocs.yml: pages of files that lie outside docs/, and the
commands with their options.

The changelog becomes a page. A link from a page of docs/ to a source file
(`../mgs/policy/criteria.py`), which is right on GitHub, becomes a link to a page that shows the
file. The mark `<!-- commands -->` becomes what `mgs COMMAND --help` says.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

from mgs.cli.app import app

ROOT = Path(__file__).parent.parent
COMMANDS = "<!-- commands -->"
LINK = re.compile(r"\]\((?P<path>\.\./[^)#\s]+)(?P<rest>[^)]*)\)")
LANGUAGES = {".py": "python", ".toml": "toml"}


def target(path: str, folder: str) -> str:
    """The path from the top of the repository of what a page in a folder of docs/ links to."""
    return posixpath.normpath(posixpath.join("docs", folder, path))


def shown(path: str) -> str:
    """A page, not to be found by the search, with the text of a file."""
    language, text = (
        LANGUAGES.get(posixpath.splitext(path)[1], "text"),
        (ROOT / path).read_text(encoding="utf-8"),
    )
    return f"---\nsearch: {{exclude: true}}\nhide: [toc]\n---\n# {path}\n\n````{language}\n{text}\n````\n"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the changelog, and a page for each file outside docs/ that a page links to."""
    linked = set()
    for page in files.documentation_pages():
        linked |= {
            target(match["path"], posixpath.dirname(page.src_uri))
            for match in LINK.finditer(page.content_string)
        }
    for path in sorted(linked):
        if (ROOT / path).is_file() and not path.startswith("docs/"):
            files.append(
                File.generated(
                    config,
                    source_page(path),
                    content=shown(path),
                    inclusion=InclusionLevel.NOT_IN_NAV,
                )
            )
    files.append(
        File.generated(
            config, "changelog.md", content=(ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
        )
    )
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Point links to files outside docs/ to their pages. What has no page is left as it is, and
    `--strict` refuses it.

    Write the commands in the place of their mark.
    """
    folder = posixpath.dirname(page.file.src_uri)
    if COMMANDS in markdown:
        markdown = markdown.replace(COMMANDS, command_reference())

    def moved(match: re.Match[str]) -> str:
        uri = source_page(target(match["path"], folder))
        if files.get_file_from_path(uri) is None:
            return match[0]
        return f"]({posixpath.relpath(uri, folder or '.')}{match['rest']})"

    return LINK.sub(moved, markdown)


def source_page(path: str) -> str:
    """Where in the site the page of a source file lies."""
    return f"source/{path}.md"


def command_reference() -> str:
    """Every command of `mgs`: a heading, what it does, and a table of its arguments and options."""
    parts = []
    for name, command in vars(typer.main.get_command(app))["commands"].items():
        parts.append(f"## mgs {name}\n\n{command.help}\n")
        if command.params:
            rows = "".join(_row(parameter) for parameter in command.params)
            parts.append(f"| argument or option | meaning | default |\n| --- | --- | --- |\n{rows}")
    return "\n".join(parts)


def _row(parameter: Any) -> str:
    """A row of the table of a command. A default that is None is told with the meaning, where there
    is something to tell."""
    names = [
        name if name.startswith("-") else name.upper()
        for name in (*parameter.opts, *parameter.secondary_opts)
    ]
    written = ", ".join(
        f"`{name} {parameter.metavar}`" if parameter.metavar else f"`{name}`" for name in names
    )
    default = getattr(parameter.default, "value", parameter.default)
    shown = "required" if parameter.required else "" if default is None else f"`{default}`"
    return f"| {written} | {parameter.help.replace('|', chr(92) + '|')} | {shown} |\n"
