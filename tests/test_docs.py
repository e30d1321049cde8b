"""The README and the pages in docs/: against the code they describe, their links, their tables, and the site made of them."""

import importlib.util
import json
import re
import shutil
import subprocess
import sys
from fractions import Fraction
from html.parser import HTMLParser
from pathlib import Path

import pytest
import tiny
from markdown_it import MarkdownIt

from mgs.active.criteria import PIXEL_NOISE
from mgs.colour import SH_C0
from mgs.rotation import QUAT_MIN
from mgs.splat import constants
from mgs.splat.blocks import BLOCK_X, BLOCK_Y, TILE
from mgs.splat_ply import write_ply
from mgs.synth.scene_file import SceneFile, load_scene_file

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]


def test_every_key_of_a_scene_is_documented():
    page = (DOCS / "data.md").read_text()
    table = page.split("| key | meaning | default |\n")[1].split("\n\n")[0]
    named = {key for row in table.splitlines() for key in re.findall(r"`(\w+\.\w+)`", row.split(" | ")[0])}
    sections = {name: field.annotation.model_fields for name, field in SceneFile.model_fields.items() if name != "description"}
    assert named == {f"{section}.{key}" for section, keys in sections.items() for key in keys}


def test_the_documented_scene_is_one(tmp_path):
    (tmp_path / "mine.toml").write_text((DOCS / "data.md").read_text().split("```toml\n")[1].split("```")[0])
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
    written = {name: [float(Fraction(number)) for number in value.split(",")] for name, value in rows}
    in_code = {name: value for name, value in vars(constants).items() if name.isupper()}
    in_code |= {"BLOCK_X": BLOCK_X, "BLOCK_Y": BLOCK_Y, "TILE": TILE}
    in_code |= {"SH_C0": SH_C0, "QUAT_MIN": QUAT_MIN, "PIXEL_NOISE": PIXEL_NOISE}
    assert written == {name: list(value) if isinstance(value, tuple) else [value] for name, value in in_code.items()}


MARKDOWN = MarkdownIt("commonmark").enable("table")
"""As GitHub reads a page, as far as these pages go."""


def anchors(page):
    """What GitHub calls the headings of a page, for links to them."""
    tokens = MARKDOWN.parse(page.read_text(encoding="utf-8"))
    headings = [tokens[i + 1].children for i, token in enumerate(tokens) if token.type == "heading_open"]
    texts = ["".join(child.content for child in heading).lower() for heading in headings]
    return {re.sub(r"[^\w\- ]", "", text).replace(" ", "-") for text in texts}


def links(page):
    """Targets of the links and pictures of a page."""
    inline = [child for token in MARKDOWN.parse(page.read_text(encoding="utf-8")) for child in token.children or []]
    return {str(token.attrs.get("href") or token.attrs["src"]) for token in inline if token.type in ("link_open", "image")}


def broken_links(page):
    """Those of a page's links and pictures in the repository that lead nowhere."""
    broken = set()
    for link in links(page):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if not re.match(r"https?://", link) and (not target.exists() or (anchor and anchor not in anchors(target))):
            broken.add(link)
    return broken


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
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
        self.addresses += [attributes[name] for name in ("src", "data", "poster") if attributes.get(name)]
        if tag == "link" and attributes.get("rel") not in ("prev", "next"):
            self.addresses.append(attributes["href"])


WITHOUT_NETWORK = """
import runpy, socket

def refuse(*_):
    raise OSError("the documentation is built without a network")

socket.socket.connect = socket.getaddrinfo = refuse
runpy.run_module("mkdocs", run_name="__main__")
"""


def test_the_site_is_built_without_warnings_and_needs_no_network(tmp_path):
    command = [sys.executable, "-c", WITHOUT_NETWORK, "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, env={"NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    pages = sorted(tmp_path.rglob("*.html"))
    assert {page.stem for page in PAGES[1:]} | {"changelog"} <= {page.stem for page in pages}
    for page in pages:
        loaded = Loaded()
        loaded.feed(page.read_text(encoding="utf-8"))
        assert loaded.addresses
        for address in loaded.addresses:
            assert not re.match(r"(https?:)?//", address), f"{page.name}: {address}"
            assert page.name == "404.html" or (page.parent / address.partition("#")[0].partition("?")[0]).exists(), address
    for sheet in tmp_path.rglob("*.css"):
        assert not re.search(r"(url\(|@import)\s*[\"']?(https?:)?//", sheet.read_text(encoding="utf-8")), sheet.name


@pytest.fixture(scope="module")
def tables():
    """tools/tables.py, which is no part of the package."""
    spec = importlib.util.spec_from_file_location("tables", ROOT / "tools/tables.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_tables_are_what_their_numbers_say(tables, capsys):
    assert tables.main(["--check"]) == 0, capsys.readouterr().err
    used = {match["name"] for page in PAGES for match in tables.MARK.finditer(page.read_text()) if match["name"]}
    assert used == set(tables.TABLES)


def test_a_stale_table_is_found_and_made_anew(tables, tmp_path, capsys):
    (tmp_path / "docs").mkdir()
    for page in PAGES:
        shutil.copy(page, tmp_path / page.relative_to(ROOT))
    numbers = tmp_path / "docs/benchmarks"
    shutil.copytree(DOCS / "benchmarks", numbers)
    measured = json.loads((numbers / "splat.json").read_text())
    measured["seconds"]["forward_warm"] = 0.0271
    (numbers / "splat.json").write_text(json.dumps(measured))
    assert tables.main(["--check"], tmp_path) == 1
    assert capsys.readouterr().err.count("stale") == 2
    assert (tmp_path / "README.md").read_text() == (ROOT / "README.md").read_text()
    assert tables.main([], tmp_path) == 0
    assert "| 27.1 ms |" in (tmp_path / "README.md").read_text()
    assert "| 27.1 ms |" in (tmp_path / "docs/splatting.md").read_text()
    assert tables.main(["--check"], tmp_path) == 0


@pytest.mark.parametrize(
    ("page", "message"),
    [
        ("<!-- table: mine -->\n<!-- end of table -->", "no such table"),
        ("<!-- table: demo -->\n", "no partner"),
        ("<!-- end of table -->\n<!-- table: demo -->", "pairs"),
        ("<!-- table: demo -->\n<!-- table: demo -->", "pairs"),
    ],
)
def test_marks_of_tables_that_are_wrong(tables, page, message):
    with pytest.raises(ValueError, match=message):
        tables.rewritten(page, DOCS / "benchmarks")
