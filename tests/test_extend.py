"""The diffs of docs/howto/extend.md apply to one file each, and what they add works."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
USE = """
import numpy as np
from mgs import runtime
runtime.start()
import mitsuba as mi
from mgs.fit.losses import LOSSES
from mgs.metrics import METRICS, compare
from mgs.run.policies import POLICIES
from mgs.splat import ESTIMATORS

scores = POLICIES["highest"].rule(np.array([[0, 0, 1.0], [0, 0, 3]]), None, None)
assert scores.tolist() == [1, 3]
one, two = mi.Float([1, 2, 3]), mi.Float([1, 4, 0])
assert LOSSES["absolute"](one, two, mi.Float(1), (1, 1, 3), True).numpy().tolist() == [0, 2, 3]
assert "halved" in ESTIMATORS
white = np.ones((16, 16, 4))
metrics = compare(white, np.zeros((16, 16, 3)), np.ones((16, 16), bool), np.ones((16, 16)))
assert list(metrics) == list(METRICS)
assert abs(metrics["mae"] - 1) < 1e-6
"""


def test_each_diff_touches_one_file_and_what_they_add_works(tmp_path):
    page = (ROOT / "docs/howto/extend.md").read_text()
    diffs = re.findall(r"```diff\n(.*?)```", page, re.DOTALL)
    assert len(diffs) == 4
    shutil.copytree(ROOT / "mgs", tmp_path / "mgs", ignore=shutil.ignore_patterns("__pycache__"))
    for diff in diffs:
        assert diff.count("\n+++ ") == 1
        command = ["git", "apply", "--unidiff-zero", "-"]
        subprocess.run(command, input=diff, text=True, cwd=tmp_path, check=True)
    subprocess.run([sys.executable, "-c", USE], cwd=tmp_path, check=True)
