"""README and docs/: commands, links, names and constants are right; pages run on small data."""

import importlib.util
import json
import re
import shlex
import shutil
import sys
from fractions import Fraction
from pathlib import Path

import pytest
import synthetic
import tiny
import typer
from markdown_it import MarkdownIt

import mgs
from mgs import InputError, write_ply
from mgs.cli.app import app
from mgs.colour import SH_C0
from mgs.data.sources import RECORDINGS
from mgs.fit.stopping import StopReason
from mgs.policy.criteria import PIXEL_NOISE
from mgs.rotation import QUAT_MIN
from mgs.run.ending import RunEnd
from mgs.run.policies import POLICIES
from mgs.splat import ESTIMATORS, constants
from mgs.splat.blocks import BLOCK_X, BLOCK_Y, TILE
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


def test_every_option_that_a_page_names_is_one():
    """Check code that begins with --, in a sentence: `--dome N`."""
    parsers = [study_of(path.stem).parser() for path in (ROOT / "studies").glob("[!_]*.py")
               if "STUDY" in path.read_text()]  # fmt: skip
    known = {name for parser in parsers for name in parser._option_string_actions}
    for command in COMMANDS.values():
        known |= {name for one in command.params for name in (*one.opts, *one.secondary_opts)}
    named = {
        (page.stem, name)
        for page in PAGES
        for name in re.findall(r"`(--[\w-]+)", page.read_text(encoding="utf-8"))
    }
    assert {(page, name) for page, name in named if name not in known} == set()


HOWTO = sorted((ROOT / "docs/howto").glob("*.md"))


@pytest.fixture(scope="module")
def pages():
    """tools/pages.py, which is not in the package."""
    spec = importlib.util.spec_from_file_location("pages", ROOT / "tools/pages.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def data(tmp_path_factory, coarse_priors):
    """Inputs of the how-to pages: demo, photos with depth, a COLMAP model, masks, a mesh."""
    folder = tmp_path_factory.mktemp("readers")
    dataset = synthetic.write_dataset(folder / "demo/dataset", synthetic.orbit_cameras(10, 48, 36))
    prior = mgs.build_prior(dataset, mgs.PriorSettings(gaussians=300))
    mgs.save_prior(folder / "demo/prior", prior)
    photos = synthetic.write_dataset(folder / "photos", synthetic.orbit_cameras(10, 48, 36))
    synthetic.write_colmap(photos, folder / "colmap", True)
    shutil.copytree(photos.root / "masks", folder / "masks")
    synthetic.rock_mesh().export(folder / "rock.ply")
    return folder


@pytest.fixture
def quick(coarse_rocks, coarse_priors, short_fits):
    """Coarse rocks and priors, and short fits."""


@pytest.fixture
def tables_restored():
    """Remove the rows and the module that a page adds."""
    tables = [(table, dict(table)) for table in (POLICIES, ESTIMATORS, RECORDINGS)]
    yield
    for table, rows in tables:
        table.clear()
        table.update(rows)
    sys.modules.pop("my_mgs", None)
    sys.modules.pop("mine", None)


@pytest.mark.slow
def test_the_tutorial_prints_what_it_shows(pages, tmp_path):
    assert pages.run_page(pages.TUTORIAL, tmp_path)[1] == []


def without_numbers(text):
    return re.sub(r"-?\d+(\.\d+)?(e[+-]?\d+)?", "0", text)


@pytest.mark.usefixtures("quick")
def test_the_tutorial_prints_the_words_that_it_shows(pages, tmp_path):
    """With smaller images and shorter fits, so that the numbers are others."""
    text, small = pages.TUTORIAL.read_text(), tmp_path / "tutorial.md"
    for old, new in (
        ("width=160, height=120, frames=12, spp=4", "width=48, height=36, frames=8, spp=1"),
        ("gaussians=2000", "gaussians=300"),
    ):
        assert old in text
        text = text.replace(old, new)
    small.write_text(text)
    page = pages.run_page(small, tmp_path)[0]
    assert without_numbers(page) == without_numbers(text)
    assert page.count("```text") >= 8
    assert all((tmp_path / picture).is_file() for picture in pages.PICTURES)
    keys = json.loads((tmp_path / "out/d-optimal/steps.jsonl").read_text().splitlines()[-1])
    documented = set(re.findall(r"`(\w+)`", (ROOT / "docs/nbv.md").read_text()))
    assert set(keys) <= documented


def test_the_notebooks_are_their_pages(pages):
    """Their code cells are the blocks that the tests of the pages execute; commands run by the
    kernel's Python, whatever its PATH is."""
    for page in pages.NOTEBOOKS:
        made = pages.notebook(page.read_text())
        assert page.with_suffix(".ipynb").read_text() == made, "run python tools/pages.py --write"
        assert not re.search(r'"!(mgs|python)\b', made)


SMALLER = {
    "--dome 40 --set": "--prior demo/prior --dome 12 --set", "flight.length=30": "flight.length=18",
    "--dome 40": "--dome 12", "120x90": "48x36", "width=120, height=90": "width=48, height=36",
    "images=8": "images=2", "(1, 16, 256)": "(1, 4, 64)", "frames=2, spp=4": "frames=2, spp=1",
    "errors[256] < errors[16]": "errors[64] < errors[4]", "tolerance=0.1": "tolerance=0.5",
    "Information(model, cameras[:4])": "Information(model, cameras[:1])",
    "--spp 4 --test-views 4": "--spp 1 --test-views 1",
    **{f"--budget {count}": "--budget 1" for count in (2, 3, 4)},
}  # fmt: skip


def test_what_pages_are_run_with_is_smaller_than_what_they_show():
    text = "".join(page.read_text() for page in HOWTO)
    assert [old for old in SMALLER if old not in text] == []


@pytest.mark.parametrize("page", HOWTO, ids=lambda page: page.stem)
@pytest.mark.usefixtures("quick", "tables_restored")
def test_a_how_to_page_can_be_followed(pages, data, page, tmp_path):
    """With fewer poses to rate and random images, and smaller pictures."""
    small, text = tmp_path / page.name, page.read_text()
    for old, new in SMALLER.items():
        text = text.replace(old, new)
    small.write_text(text)
    assert pages.run_page(small, data)[1] == []


def test_words_and_whole_numbers_must_be_those_shown(pages):
    shown = "kf_0002: 3 images, 99.1 %\n"
    assert pages.alike(shown, "kf_0002:  3 images, 97.0 %\n")
    for wrong in ("kf_0002: 3 images, 90.0 %\n", "kf_0002: 4 images, 99.1 %\n"):
        assert not pages.alike(shown, wrong)


def test_other_output_is_found_and_written(pages, tmp_path):
    page = tmp_path / "page.md"
    text = (
        '# A page\n\n```python title="mine.py"\nx = 1 + 1\n```\n\n'
        "```python\nimport mine\n\nprint(mine.x)\n```\n\n```text\n3\n```\n"
    )
    page.write_text(text)
    rewritten, differences = pages.run_page(page, tmp_path)
    sys.modules.pop("mine")
    assert differences == ["line 14: shows\n3\nbut this was printed:\n2\n"]
    assert rewritten == text.replace("text\n3\n", "text\n2\n")


def test_a_failing_command_stops_the_page(pages, tmp_path):
    (tmp_path / "page.md").write_text("```sh\nmgs eval nothing   # there is no such run\n```\n")
    with pytest.raises(RuntimeError, match="mgs eval nothing: exit code 2"):
        pages.run_page(tmp_path / "page.md", tmp_path)
