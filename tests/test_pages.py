"""The tutorial and the how-to pages run as they stand, on small data."""

import importlib.util
import json
import re
import shutil
import sys
from pathlib import Path

import pytest
import synthetic

import mgs
from mgs.data.sources import RECORDINGS
from mgs.run.policies import POLICIES
from mgs.splat import ESTIMATORS
from mgs.synth import rendering

ROOT = Path(__file__).parent.parent
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
    dataset = synthetic.write_dataset(folder / "demo/dataset", synthetic.orbit_cameras(14, 48, 36))
    prior = mgs.build_prior(dataset, mgs.PriorSettings(gaussians=300))
    mgs.save_prior(folder / "demo/prior", prior)
    photos = synthetic.write_dataset(folder / "photos", synthetic.orbit_cameras(10, 48, 36))
    synthetic.write_colmap(photos, folder / "colmap", True)
    shutil.copytree(photos.root / "masks", folder / "masks")
    synthetic.rock_mesh().export(folder / "rock.ply")
    return folder


@pytest.fixture
def quick(monkeypatch, coarse_arena, coarse_priors, short_fits):
    """Coarse rocks and priors, and short fits."""
    make_rock = rendering.make_rock

    def coarse(rock, rng):
        return make_rock(rock.model_copy(update={"detail": rock.size / 30}), rng)

    monkeypatch.setattr(rendering, "make_rock", coarse)


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
        ("width=160, height=120, frames=12, spp=4", "width=48, height=36, frames=12, spp=1"),
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


@pytest.mark.parametrize("page", HOWTO, ids=lambda page: page.stem)
@pytest.mark.usefixtures("quick", "tables_restored")
def test_a_how_to_page_can_be_followed(pages, data, page):
    assert pages.run_page(page, data)[1] == []


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
