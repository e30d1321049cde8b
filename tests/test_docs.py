"""README and docs/: commands, links, names and constants are those of the code."""

import re
import shlex
from fractions import Fraction
from pathlib import Path

import pytest
import tiny
import typer
from markdown_it import MarkdownIt

import mgs
from mgs.cli.app import app
from mgs.colour import SH_C0
from mgs.errors import InputError
from mgs.fit.stopping import StopReason
from mgs.policy.criteria import PIXEL_NOISE
from mgs.rotation import QUAT_MIN
from mgs.run.ending import RunEnd
from mgs.run.policies import POLICIES
from mgs.splat import ESTIMATORS, constants
from mgs.splat.blocks import BLOCK_X, BLOCK_Y, TILE
from mgs.splat_ply import write_ply
from mgs.synth.scene_file import SceneFile
from studies.frame.program import study_of

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
MARKDOWN = MarkdownIt("commonmark").enable("table")
COMMANDS = vars(typer.main.get_command(app))["commands"]
every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)


def rows(page, heading):
    """Rows of the table whose heading row starts so, as lists of cells."""
    table = (DOCS / page).read_text().split(f"\n{heading}")[1].split("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in table]


def quoted(page, heading):
    """Names in backticks in the first column of a table."""
    return [name for row in rows(page, heading) for name in re.findall(r"`([\w.-]+)`", row[0])]


def test_every_key_of_a_scene_is_documented():
    sections = {name: field.annotation for name, field in SceneFile.model_fields.items()}
    del sections["description"]
    keys = {f"{name}.{key}" for name, section in sections.items() for key in section.model_fields}
    assert set(quoted("data.md", "| key | meaning")) == keys


def test_the_constants_of_the_notation_are_those_of_the_code():
    written = {
        row[0].strip("`"): [float(Fraction(number)) for number in row[1].split(",")]
        for row in rows("notation.md", "| name | value")
    }
    in_code = {name: value for name, value in vars(constants).items() if name.isupper()}
    in_code |= {"BLOCK_X": BLOCK_X, "BLOCK_Y": BLOCK_Y, "TILE": TILE}
    in_code |= {"SH_C0": SH_C0, "QUAT_MIN": QUAT_MIN, "PIXEL_NOISE": PIXEL_NOISE}
    assert written == {
        name: list(value) if isinstance(value, tuple) else [value]
        for name, value in in_code.items()
    }


def test_tables_of_names_are_complete():
    assert quoted("nbv.md", "| `--policy`") == list(POLICIES)
    assert quoted("nbv.md", "| reason |") == [str(reason) for reason in StopReason]
    assert quoted("nbv.md", "| `ended` |") == [str(reason) for reason in RunEnd]
    assert set(quoted("howto/estimator.md", "| name | what")) == set(ESTIMATORS) - {"block"}


def test_rooms_and_api_pages_are_those_of_the_package():
    folders = {path.parent.name for path in (ROOT / "mgs").glob("*/__init__.py")}
    assert set(quoted("architecture.md", "| room |")) == folders
    pages = {f"mgs.{path.stem}" for path in (ROOT / "mgs").glob("[!_]*.py")}
    pages |= {f"mgs.{name}" for name in (folders - {"cli"}) | set(mgs.__all__)}
    documented = [
        name
        for page in [DOCS / "api.md", *DOCS.glob("api/*.md")]
        for name in re.findall(r"^::: (\S+)$", page.read_text(), re.MULTILINE)
    ]
    assert sorted(documented) == sorted(pages)
    nav = (ROOT / "mkdocs.yml").read_text()
    assert [page for page in PAGES[1:] if f": {page.relative_to(DOCS)}\n" not in nav] == []


def test_the_program_in_the_readme_runs(dataset, tmp_path, monkeypatch):
    write_ply(tmp_path / "gaussians.ply", tiny.initial([]))
    (dataset / "transforms.json").rename(tmp_path / "transforms.json")
    monkeypatch.chdir(tmp_path)
    variables: dict = {}
    exec(PAGES[0].read_text().split("```python\n")[1].split("```")[0], variables)
    assert variables["information"].shape == (tiny.POINTS, 11)
    assert variables["information"].max() > 0


@every_page
def test_every_link_and_picture_leads_somewhere(page):
    """`make docs` tries the anchors."""
    tokens = MARKDOWN.parse(page.read_text(encoding="utf-8"))
    inline = [child for token in tokens for child in token.children or []]
    links = [str(one.attrs.get("href") or one.attrs.get("src") or "") for one in inline]
    files = {link.partition("#")[0] for link in links if not re.match(r"https?://", link)}
    assert {file for file in files if not (page.parent / file).exists()} == set()


def command_lines(page):
    """Yield (words, whether the line stands in a block) of every `mgs ...` and `python -m
    studies.NAME ...` of a page, as NAME ..."""
    for token in MARKDOWN.parse(page.read_text(encoding="utf-8")):
        if token.type == "fence" and token.info in ("", "sh"):
            lines = [(line, True) for line in token.content.splitlines()]
        else:
            code = [child for child in token.children or [] if child.type == "code_inline"]
            lines = [(child.content, False) for child in code]
        for line, whole in lines:
            if match := re.match(r"(mgs |python -m (?=studies\.))(?=[a-z])(?!studies\.NAME)", line):
                yield shlex.split(line[match.end() :], comments=True), whole


def wrong_command(words, whole):
    """Error of a command line, else None. Options may stand in brackets."""
    name, *rest = words
    options = {word.strip("[]") for word in rest if word.strip("[").startswith("--")}
    if name.startswith("studies."):
        parser = study_of(name.removeprefix("studies.")).parser()
        known, parse = set(parser._option_string_actions), parser.parse_args
    elif name in COMMANDS:
        params = COMMANDS[name].params
        known = {name for one in params for name in (*one.opts, *one.secondary_opts)} | {"--help"}
        parse = lambda rest: COMMANDS[name].make_context(name, rest)  # noqa: E731
    else:
        return f"no command {name}"
    if not known >= options:
        return f"{name} has no {options - known}"
    if whole and not any(word.startswith("[") for word in rest):
        try:
            parse(rest)
        except (typer.TyperException, InputError) as error:
            return str(error)
    return None


@every_page
def test_every_command_line_is_one(page):
    wrong = {" ".join(words): wrong_command(words, whole) for words, whole in command_lines(page)}
    assert {line: problem for line, problem in wrong.items() if problem} == {}
