"""`outlier` of clean fits and of fits with one wrong image or one wrong pose.

`python benchmarks/outlier.py OUT` fits every third of 36 views on a dome around ten rocks. The
wrong image is another view's, with its mask, and the wrong pose is turned by 6 degrees about the
middle of the scene. OUT may hold the cells of `mgs reproduce OUT --only setups`.
"""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mgs import runtime

runtime.start()

from mgs.run.nbv import resume_nbv, start_fit  # noqa: E402
from mgs.study.reproduce import SIZES  # noqa: E402
from mgs.study.rocks import FRESH, Rock  # noqa: E402
from mgs.study.setups import SETUPS, case_of  # noqa: E402
from mgs.study.sweep import run_cells  # noqa: E402

KINDS = ("clean", "image", "pose")


def spoil(dataset: Path, kind: str, rng: np.random.Generator) -> None:
    """Keep every third frame of a dataset, and spoil one of them."""
    file = dataset / "transforms.json"
    listed = json.loads(file.read_text())
    frames = listed["frames"] = listed["frames"][::3]
    bad = int(rng.integers(len(frames)))
    frame, other = frames[bad], frames[(bad + 1 + int(rng.integers(11))) % 12]
    if kind == "image":
        for key in ("file_path", "rock_file_path", "mask_path"):
            shutil.copy(dataset / other[key], dataset / frame[key])
    if kind == "pose":
        axis, pose = rng.normal(size=3), np.array(frame["transform_matrix"])
        turn = Rotation.from_rotvec(np.radians(6) * axis / np.linalg.norm(axis)).as_matrix()
        pose[:3] = turn @ pose[:3]
        frame["transform_matrix"] = pose.tolist()
    file.write_text(json.dumps(listed))


def main(out: Path) -> None:
    """Print the indicator and the warnings of every fit."""
    for rock in (Rock("boulder", 1, 0), Rock("strata", 1, 1), *FRESH[:8]):
        case = case_of(rock, SETUPS["hemisphere"], SIZES["quick"].setups)
        run_cells(out, case.cells(), lambda cell, done, total: None)
        for kind in KINDS:
            work = out / "outlier" / rock.name / kind
            shutil.copytree(out / case.dataset, work)
            spoil(work, kind, np.random.default_rng(sum(map(ord, rock.name))))
            run = resume_nbv(start_fit(work, work / "run", prior=out / case.prior))
            step = run.state.steps[-1]
            said = [warning.split(":")[0] for warning in step.get("warnings", [])]
            print(rock.name, kind, f"{step['indicators']['outlier']:.2f}", said, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
