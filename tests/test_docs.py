"""The README and the pages in docs/ against the code they describe."""

import re
from pathlib import Path

import tiny

from mgs.scene_file import SceneFile, load_scene_file
from mgs.splat_ply import write_ply

DOCS = Path(__file__).parent.parent / "docs"


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
