"""The README and the pages in docs/ against the code they describe, and their tables against the numbers."""

import importlib.util
import json
import re
import shutil
from pathlib import Path

import pytest
import tiny

from mgs.gaussians import write_ply
from mgs.scene_file import SceneFile, load_scene_file

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
