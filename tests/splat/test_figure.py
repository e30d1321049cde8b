"""The picture of docs/splatting.md is drawn from the kernels' own data, so it is drawn again whenever those change."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_figure_of_the_splat_kernel_is_drawn(tmp_path):
    script = ROOT / "benchmarks/splatting_figure.py"
    run = subprocess.run([sys.executable, script, tmp_path / "figure.png"], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert (tmp_path / "figure.png").stat().st_size > 50_000
