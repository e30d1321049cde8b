"""The README and the pages in docs/: against the code they describe, their links, and the site
made of them."""

import ast
import pkgutil
import re
import shlex
import subprocess
import sys
import zlib
from fractions import Fraction
from html.parser import HTMLParser
from pathlib import Path

import pytest
import tiny
import typer
from markdown_it import MarkdownIt

import mgs
from mgs.cli.app import app
from mgs.colour import SH_C0
from mgs.data.dataset import load_dataset
from mgs.fit.stopping import StopReason
from mgs.policy.criteria import PIXEL_NOISE
from mgs.policy.registry import policy_names
from mgs.rotation import QUAT_MIN
from mgs.run import loop
from mgs.run.ending import RunEnd
from mgs.splat import ESTIMATORS, constants
from mgs.splat.blocks import BLOCK_X, BLOCK_Y, TILE
from mgs.splat_ply import write_ply
from mgs.synth.scene_file import SceneFile, load_scene_file

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]


def test_every_key_of_a_scene_is_documented():
    page = (DOCS / "data.md").read_text()
    table = page.split("| key | meaning | default |\n")[1].split("\n\n")[0]
    named = {
        key
        for row in table.splitlines()
        for key in re.findall(r"`(\w+\.\w+)`", row.split(" | ")[0])
    }
    sections = {
        name: field.annotation.model_fields
        for name, field in SceneFile.model_fields.items()
        if name != "description"
    }
    assert named == {f"{section}.{key}" for section, keys in sections.items() for key in keys}


def test_the_documented_scene_is_one(tmp_path):
    (tmp_path / "mine.toml").write_text(
        (DOCS / "data.md").read_text().split("```toml\n")[1].split("```")[0]
    )
    assert load_scene_file(tmp_path / "mine.toml").rock.size == 0.6


def test_the_program_in_the_readme_runs(dataset, tmp_path, monkeypatch):
    write_ply(tmp_path / "gaussians.ply", tiny.initial([]))
    (dataset / "transforms.json").rename(tmp_path / "transforms.json")
    monkeypatch.chdir(tmp_path)
    variables: dict = {}
    exec((DOCS.parent / "README.md").read_text().split("```python\n")[1].split("```")[0], variables)
    assert variables["information"].shape == (tiny.POINTS, 11)
    assert variables["information"].max() > 0


def test_the_constants_of_the_notation_are_those_of_the_code():
    table = (DOCS / "notation.md").read_text().split("## Constants")[1]
    rows = re.findall(r"^\| `(\w+)` \| ([^|]+) \|", table, re.MULTILINE)
    written = {
        name: [float(Fraction(number)) for number in value.split(",")] for name, value in rows
    }
    in_code = {name: value for name, value in vars(constants).items() if name.isupper()}
    in_code |= {"BLOCK_X": BLOCK_X, "BLOCK_Y": BLOCK_Y, "TILE": TILE}
    in_code |= {"SH_C0": SH_C0, "QUAT_MIN": QUAT_MIN, "PIXEL_NOISE": PIXEL_NOISE}
    assert written == {
        name: list(value) if isinstance(value, tuple) else [value]
        for name, value in in_code.items()
    }


MARKDOWN = MarkdownIt("commonmark").enable("table")
"""As GitHub reads a page, as far as these pages go."""


def anchors(page):
    """What GitHub calls the headings of a page, for links to them."""
    tokens = MARKDOWN.parse(page.read_text(encoding="utf-8"))
    headings = [
        tokens[i + 1].children for i, token in enumerate(tokens) if token.type == "heading_open"
    ]
    texts = ["".join(child.content for child in heading).lower() for heading in headings]
    return {re.sub(r"[^\w\- ]", "", text).replace(" ", "-") for text in texts}


def links(page):
    """Targets of the links and pictures of a page."""
    inline = [
        child
        for token in MARKDOWN.parse(page.read_text(encoding="utf-8"))
        for child in token.children or []
    ]
    return {
        str(token.attrs.get("href") or token.attrs["src"])
        for token in inline
        if token.type in ("link_open", "image")
    }


def broken_links(page):
    """Those of a page's links and pictures in the repository that lead nowhere."""
    broken = set()
    for link in links(page):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if not re.match(r"https?://", link) and (
            not target.exists() or (anchor and anchor not in anchors(target))
        ):
            broken.add(link)
    return broken


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_and_picture_leads_somewhere(page):
    assert broken_links(page) == set()


def test_a_broken_link_is_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# At the paper's `size`\n[a](#at-the-papers-size) [b](page.md#size) [c](x.md)\n\n| ![d](y.png) |\n| --- |\n"
    )
    assert broken_links(page) == {"page.md#size", "x.md", "y.png"}


class Loaded(HTMLParser):
    """Addresses that a browser loads to show a page."""

    def __init__(self):
        super().__init__()
        self.addresses = []

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.addresses += [
            attributes[name] for name in ("src", "data", "poster") if attributes.get(name)
        ]
        if tag == "link" and attributes.get("rel") not in ("prev", "next"):
            self.addresses.append(attributes["href"])


WITHOUT_NETWORK = """
import runpy, socket

def refuse(*_):
    raise OSError("the documentation is built without a network")

socket.socket.connect = socket.getaddrinfo = refuse
runpy.run_module("mkdocs", run_name="__main__")
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built without warnings and without a network."""
    folder = tmp_path_factory.mktemp("site")
    command = [
        sys.executable,
        "-c",
        WITHOUT_NETWORK,
        "build",
        "--strict",
        "--site-dir",
        str(folder),
    ]
    done = subprocess.run(
        command, cwd=ROOT, env={"NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_the_site_has_every_page_and_loads_nothing_from_the_network(site):
    pages = sorted(site.rglob("*.html"))
    written = {page.relative_to(site).with_suffix("") for page in pages}
    assert {page.relative_to(DOCS).with_suffix("") for page in PAGES[1:]} | {
        Path("changelog")
    } <= written
    for page in pages:
        loaded = Loaded()
        loaded.feed(page.read_text(encoding="utf-8"))
        assert loaded.addresses
        for address in loaded.addresses:
            assert not re.match(r"(https?:)?//", address), f"{page.name}: {address}"
            assert (
                page.name == "404.html"
                or (page.parent / address.partition("#")[0].partition("?")[0]).exists()
            ), address
    for sheet in site.rglob("*.css"):
        assert not re.search(
            r"(url\(|@import)\s*[\"']?(https?:)?//", sheet.read_text(encoding="utf-8")
        ), sheet.name


def test_every_public_name_stands_on_the_api_page():
    named = re.findall(r"^::: mgs\.(\w+)$", (DOCS / "api.md").read_text(), re.MULTILINE)
    assert sorted(named) == sorted(mgs.__all__)


def test_the_api_pages_hold_every_module_and_what_is_public(site):
    """By the inventory that mkdocstrings writes of what it has shown."""
    shown = (
        zlib.decompress((site / "objects.inv").read_bytes().split(b"\n", 4)[4])
        .decode()
        .splitlines()
    )
    names = {line.split()[0] for line in shown}
    modules = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in (ROOT / "mgs").rglob("*.py")
    }
    assert {
        name for name in modules if "__" not in name and not name.startswith("mgs.cli.")
    } <= names
    assert {f"mgs.{name}" for name in mgs.__all__} <= names
    assert {
        "mgs.splat.information.ESTIMATORS",
        "mgs.policy.criteria.CRITERIA",
        "mgs.Camera.project",
    } <= names


def test_the_page_of_commands_has_every_option(site):
    page = (site / "api/cli.html").read_text()
    for name, command in COMMANDS.items():
        assert f'id="mgs-{name}"' in page
        for parameter in command.params:
            assert all(option in page for option in parameter.opts if option.startswith("-")), (
                name,
                parameter.opts,
            )


COMMANDS = vars(typer.main.get_command(app))["commands"]
"""The commands of the program, by name."""


def command_lines(page):
    """(line of `mgs ...` as words, whether it stands whole in a block of its own) of a page."""
    for token in MARKDOWN.parse(page.read_text(encoding="utf-8")):
        if token.type == "fence" and token.info in ("", "sh"):
            lines = [(line, True) for line in token.content.splitlines()]
        else:
            lines = [
                (child.content, False)
                for child in token.children or []
                if child.type == "code_inline"
            ]
        yield from (
            (shlex.split(line, comments=True), whole)
            for line, whole in lines
            if re.match(r"mgs [a-z]", line)
        )


def wrong_command(words, whole):
    """What is wrong with a command line as a page writes it; None where it is right. Options may
    stand in brackets."""
    command, options = (
        COMMANDS.get(words[1]),
        [word.strip("[]") for word in words if word.strip("[").startswith("--")],
    )
    if command is None:
        return f"no command {words[1]}"
    known = {
        name
        for parameter in command.params
        for name in (*parameter.opts, *parameter.secondary_opts)
    } | {"--help"}
    if not known >= set(options):
        return f"{words[1]} has no {set(options) - known}"
    if whole and not any(word.startswith("[") for word in words):
        try:
            command.make_context(words[1], words[2:])
        except typer.TyperException as error:
            return error.format_message()
    return None


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_command_line_is_one(page):
    wrong = {" ".join(words): wrong_command(words, whole) for words, whole in command_lines(page)}
    assert {line: problem for line, problem in wrong.items() if problem} == {}


def test_command_lines_are_found_and_read(tmp_path):
    block = "mgs prior D --spacing many   # no\nmgs nbv D [--lamb 1]\nmgs eval R # yes\n"
    (tmp_path / "page.md").write_text(f"`mgs nbv D --polcy P` `mgs fly`\n```\n{block}```\n")
    found = [wrong_command(words, whole) for words, whole in command_lines(tmp_path / "page.md")]
    assert found[:2] == ["nbv has no {'--polcy'}", "no command fly"]
    assert found[2].startswith("Invalid value for '--spacing'")
    assert found[3:] == ["nbv has no {'--lamb'}", None]


def rows(page, heading):
    """Rows of the table with this heading row (its start), as lists of cells."""
    table = page.split(f"\n{heading}")[1].split("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in table]


def test_the_rooms_of_the_architecture_are_those_of_the_package():
    page = (DOCS / "architecture.md").read_text()
    table = {
        row[0].strip("`"): re.findall(r"`(\w+)`", row[1]) for row in rows(page, "| room | modules")
    }
    base = table.pop("base modules")
    folders = {path.parent.name for path in (ROOT / "mgs").glob("*/__init__.py")}
    assert set(table) == folders
    assert sorted(base) == sorted(
        path.stem for path in (ROOT / "mgs").glob("*.py") if not path.stem.startswith("__")
    )
    for room, modules in table.items():
        assert modules
        assert all((ROOT / "mgs" / room / f"{module}.py").is_file() for module in modules), room
    boxes = re.findall(
        r'font-size="12" [^>]*>([^<]+)</text>', (DOCS / "images/architecture.svg").read_text()
    )
    drawn = {name for text in boxes for name in re.findall(r"[\w_]+", text)} - {
        "one",
        "file",
        "per",
        "command",
    }
    assert drawn <= {path.stem for path in (ROOT / "mgs").rglob("*.py")}
    for name in re.findall(
        r"`((?:active|splat|synth|data|cli|files|runtime|bench)\.[\w.]+)`", page
    ):
        assert pkgutil.resolve_name(f"mgs.{name}"), name


def test_the_modules_that_import_drjit_are_those_that_the_architecture_names():
    page = " ".join((DOCS / "architecture.md").read_text().split())
    named = page.split("Outside of it these modules import them:")[1].split("`. ")[0] + "`"
    importing = set()
    for path in (ROOT / "mgs").rglob("*.py"):
        tree = ast.parse(path.read_text())
        names = [
            alias.name for node in tree.body if isinstance(node, ast.Import) for alias in node.names
        ]
        if {"drjit", "mitsuba"} & set(names):
            importing.add(".".join(path.relative_to(ROOT / "mgs").with_suffix("").parts))
    assert set(re.findall(r"`([\w.]+)`", named)) == {
        name for name in importing if not name.startswith("splat.")
    }
    assert not {"splat.constants", "splat.reference"} & importing


def test_the_tables_of_the_loop_are_those_of_the_code(dataset, tmp_path):
    page = (DOCS / "nbv.md").read_text()
    assert [row[0].strip("`") for row in rows(page, "| `--policy`")] == policy_names()
    assert [row[0].strip("`") for row in rows(page, "| reason |")] == [
        str(reason) for reason in StopReason
    ]
    assert [row[0].strip("`") for row in rows(page, "| `ended` |")] == [
        str(reason) for reason in RunEnd
    ]
    keys = {
        key
        for row in rows(page, "| key of `steps.jsonl`")
        for key in re.findall(r"`(\w+)`", row[0])
    }
    loaded = load_dataset(dataset)
    settings = tiny.start(tmp_path / "run", loaded, budget=1, evaluate_every=1)
    qualities = {
        f"{views}{name}": 1.0
        for views in ("", "held_out_", "test_")
        for name in ("psnr", "psnr_mask")
    }
    stations = tiny.stations(measure=lambda gaussians, taken: qualities)
    state = loop.run(tmp_path / "run", settings, loaded, stations, tiny.silent)
    keys -= {
        "signs",
        "warnings",
        "exposure",
        "residual",
    }  # of renders and images, which the stand-ins do not make
    assert keys == set(state.steps[1]) == set(state.steps[0]) - {"seeds", "seed_names"} | {"ended"}
    estimators = [
        row[0].strip("`")
        for row in rows((DOCS / "howto/estimator.md").read_text(), "| name | what")
    ]
    assert set(estimators) == set(ESTIMATORS) - {"block"}
