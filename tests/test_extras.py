"""The core works with its own dependencies; what an extra installs is named when it is missing."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from refusals import refused

from mgs.errors import EXTRAS

PROJECT = tomllib.loads((Path(__file__).parent.parent / "pyproject.toml").read_text())["project"]

DISTRIBUTIONS = {"sklearn": "scikit-learn", "cv2": "opencv-python-headless"}
"""Module -> package that brings it, where the names differ."""

CORE = """
import sys
for name in {blocked}:
    sys.modules[name] = None
import mgs
dataset, prior, out = sys.argv[1:]
run = mgs.run_nbv(dataset, out, prior=prior, seeds=3, budget=1, train={{"passes": 1}})
image = mgs.render(run.gaussians, run.dataset.frames[0].camera)
print(mgs.evaluate(run)["images"], image.rgb.shape)
mgs.report(run, out + "-report")
"""


def packages(requirements: list[str]) -> set[str]:
    return {re.split(r"[<>=\[]", one)[0].lower().replace("_", "-") for one in requirements}


def test_every_extra_names_its_packages_and_all_has_them():
    extras = PROJECT["optional-dependencies"]
    for module, extra in EXTRAS.items():
        package = DISTRIBUTIONS.get(module, module).lower().replace("_", "-")
        assert package in packages(extras[extra])
        assert package not in packages(PROJECT["dependencies"])
    assert set(EXTRAS.values()) == set(extras) - {"all"}  # `mgs doctor` lists them
    (every,) = extras["all"]
    assert set(every[4:-1].split(",")) == set(extras) - {"all"}


@pytest.mark.slow
def test_the_core_chooses_measures_and_reports_without_extras(dataset, prior, tmp_path):
    program = CORE.format(blocked=[*EXTRAS])
    command = [sys.executable, "-c", program, dataset, prior, tmp_path / "run"]
    said = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert said.stdout == "4 (12, 16, 3)\n", said.stderr


def test_a_missing_package_is_one_line(dataset, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    model = tmp_path / "model/sparse/0"
    model.mkdir(parents=True)
    for name in ("cameras", "images", "points3D"):
        (model / f"{name}.bin").write_bytes(bytes(8))
    line = refused(capsys, ["import", tmp_path / "model", "--out", tmp_path / "out"])
    assert line == 'mgs: this needs pycolmap, which is not installed; `pip install "mgs[import]"`'
