"""The tutorial and the how-to pages: what they tell their readers to do is done, on small data."""

import importlib.util
import shutil
import sys
from pathlib import Path

import pytest
import synthetic

import mgs
from mgs.policy import criteria
from mgs.policy import poses as pose_policies
from mgs.splat import ESTIMATORS
from mgs.synth import arena

ROOT = Path(__file__).parent.parent
HOWTO = sorted((ROOT / "docs/howto").glob("*.md"))


@pytest.fixture(scope="module")
def pages():
    """tools/pages.py, which is no part of the package."""
    spec = importlib.util.spec_from_file_location("pages", ROOT / "tools/pages.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["pages"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """What the how-to pages take for granted: the demo, photos with depth, a COLMAP model, masks,
    and a mesh of the rock."""
    folder = tmp_path_factory.mktemp("readers")
    dataset = synthetic.write_dataset(folder / "demo/dataset", synthetic.orbit_cameras(14, 48, 36))
    prior, _ = mgs.build_prior(dataset, mgs.PriorSettings(gaussians=300))
    mgs.save_prior(folder / "demo/prior", prior)
    photos = synthetic.write_dataset(folder / "photos", synthetic.orbit_cameras(10, 48, 36))
    synthetic.write_colmap(photos, folder / "colmap", True)
    shutil.copytree(photos.root / "masks", folder / "masks")
    synthetic.rock_mesh().export(folder / "rock.ply")
    return folder


@pytest.fixture
def as_before():
    """Rows that a page adds to the tables are gone at the end, and so is the module that it
    writes."""
    tables = [
        (table, dict(table))
        for table in (criteria.CRITERIA, pose_policies.POSE_POLICIES, ESTIMATORS)
    ]
    yield
    for table, rows in tables:
        table.clear()
        table.update(rows)
    sys.modules.pop("my_mgs", None)


def test_the_tutorial_prints_what_it_shows(pages, tmp_path):
    said = pages.follow(pages.TUTORIAL, tmp_path)
    assert pages.stale(said) == []
    assert sum(one.shown is not None for one in said) >= 8
    for picture in pages.PICTURES:
        assert (tmp_path / picture).is_file()


@pytest.mark.parametrize("page", HOWTO, ids=lambda page: page.stem)
def test_a_how_to_page_can_be_followed(pages, data, as_before, monkeypatch, page):
    monkeypatch.setattr(
        arena, "TEXELS", 64
    )  # of the ground's texture, which costs much and is not looked at
    said = pages.follow(page, data)
    assert pages.stale(said) == []
    assert len(said) >= 3


@pytest.mark.parametrize(
    ("printed", "same"),
    [
        ("kf_0002: 3 images, 99.1 %\n", True),
        ("kf_0002:  3 images, 97.0 %\n", True),
        ("kf_0002: 3 images, 90.0 %\n", False),
        ("kf_0003: 3 images, 99.1 %\n", False),
        ("kf_0002: 4 images, 99.1 %\n", False),
        ("kf_0002: 3 images, 99 %\n", False),
    ],
)
def test_words_and_whole_numbers_must_be_those_shown(pages, printed, same):
    assert pages.alike("kf_0002: 3 images, 99.1 %\n", printed) == same


def test_what_a_page_shows_is_found_to_be_stale_and_made_anew(pages, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        '# A page\n\n```python title="mine.py"\nx = 1 + 1\n```\n\n```python\nimport mine\n\nprint(mine.x)\n```\n\n'
        "```text\n3\n```\n\n```python\nprint('not shown')\n```\n"
    )
    said = pages.follow(page, tmp_path)
    sys.modules.pop("mine")
    assert [one.printed for one in said] == ["", "2\n", "not shown\n"]
    assert pages.stale(said) == ["line 14: shows\n3\nbut this was printed:\n2\n"]
    assert pages.rewritten(page.read_text(), said) == page.read_text().replace(
        "text\n3\n", "text\n2\n"
    )


def test_a_command_that_fails_is_told(pages, tmp_path):
    (tmp_path / "page.md").write_text("```sh\nmgs eval nothing   # there is no such run\n```\n")
    with pytest.raises(RuntimeError, match="mgs eval nothing: exit code 2"):
        pages.follow(tmp_path / "page.md", tmp_path)
