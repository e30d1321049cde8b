"""Hooks of `mkdocs build`.

They add the changelog, point links to source files to the API, replace the mark `<!-- commands -->`
by what `mgs COMMAND --help` says and marks of tables by tables of the studies' rows, and refuse a
site that loads something from a network.
"""

import re
from pathlib import Path
from typing import Any

import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from mgs.cli.app import app
from studies.frame.output import tables_of

CHANGELOG = Path(__file__).parent.parent / "CHANGELOG.md"

SOURCE = re.compile(r"\]\(\.\./mgs/(\w+)/(\w+)\.py\)")
"""Link from a page in docs/ to a module, which the site replaces by its part of the API."""

RESULTS = Path(__file__).parent.parent / "docs/results"

TABLE = re.compile(r"<!-- table (\d+) of ([\w/-]+)\.csv -->")
"""Mark of a table: its number among those that a study makes of the rows of a file in RESULTS."""

LOADED = re.compile(
    r"""<(script|img|iframe|source)\b[^>]* src="?(https?:)?//"""
    r"""|<link\b[^>]*rel="?(stylesheet|icon|preload)[^>]*href="?(https?:)?//"""
    r"""|<link\b[^>]*href="?(https?:)?//[^>]*rel="?(stylesheet|icon|preload)"""
    r"""|(url\(|@import)\s*["']?(https?:)?//"""
)
"""Pattern of HTML or CSS that loads from a network."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the changelog, which lies outside docs/ and whose links lead there from the root."""
    text = CHANGELOG.read_text(encoding="utf-8").replace("](docs/", "](")
    files.append(File.generated(config, "changelog.md", content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Replace the marks of tables and of the commands, and links to source files."""
    markdown = TABLE.sub(lambda m: tables_of(RESULTS / f"{m[2]}.csv")[int(m[1]) - 1], markdown)
    markdown = SOURCE.sub(r"](api/\1.md#mgs.\1.\2)", markdown)
    mark = "<!-- commands -->"
    return markdown.replace(mark, command_reference()) if mark in markdown else markdown


def on_post_build(config: MkDocsConfig) -> None:
    """Raise PluginError where a page or a style sheet loads from a network."""
    for path in sorted(Path(config.site_dir).rglob("*.[hc][ts][ms]*")):
        if found := LOADED.search(path.read_text(encoding="utf-8")):
            raise PluginError(f"{path}: loads from a network: {found[0]}")


def command_reference() -> str:
    """Return a heading, the help and tables of options and settings for every command of `mgs`."""
    parts = []
    for name, command in vars(typer.main.get_command(app))["commands"].items():
        parts.append(f"## mgs {name}\n\n{command.help}\n")
        if command.params:
            rows = "".join(_row(parameter) for parameter in command.params)
            parts.append(f"| argument or option | meaning | default |\n| --- | --- | --- |\n{rows}")
        if command.keys:
            rows = "".join(f"| `{key}` | {text} | {shown} |\n" for key, shown, text in command.keys)
            parts.append(
                f"| setting (`--set KEY=VALUE`) | meaning | default |\n| --- | --- | --- |\n{rows}"
            )
    return "\n".join(parts)


def _row(parameter: Any) -> str:
    names = [
        name if name.startswith("-") else name.upper()
        for name in (*parameter.opts, *parameter.secondary_opts)
    ]
    written = ", ".join(
        f"`{name} {parameter.metavar}`" if parameter.metavar else f"`{name}`" for name in names
    )
    default = getattr(parameter.default, "value", parameter.default)
    shown = "required" if parameter.required else "" if default is None else f"`{default}`"
    meaning = parameter.help.replace("|", "\\|")
    return f"| {written} | {meaning} | {shown} |\n"
