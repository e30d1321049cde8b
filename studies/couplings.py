"""Loss of a choice by the diagonal of J^T J, or by its blocks, against the whole matrix.

Eq. 7 with the diagonal (`d-optimal`), with a block for each Gaussian (`block_d`) and with the whole
matrix (`full_d` of `studies.policies`) choose from one pool after the same seeds. At each step of
the run by the whole matrix, the gains by the other two are compared with its own.
"""

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import spearmanr

import mgs
from mgs.learning import fit_views
from studies.faults import captured
from studies.frame.case import ROCKS
from studies.frame.output import grouped, scene_mean, table, write_table
from studies.frame.program import WORKERS, Study, Work, study_of
from studies.frame.statistics import Row
from studies.frame.sweep import Cell
from studies.policies import block_d, full_d
from studies.setups import SETUPS, SetupSize, case_of, shared_scene, sized

SEEDS, EVERY = 2, 3
"""Views to start with; one pose in so many of the hemisphere is a candidate."""

WHOLE = "whole matrix"

POLICIES: dict[str, Any] = {"diagonal": mgs.DOptimal(), "blocks": block_d, WHOLE: full_d}

SIZES = {
    "quick": SetupSize(images=5, gaussians=4000),
    "paper": SetupSize(320, 240, 24, 16, images=8, gaussians=25_000),
}
"""Sizes before images are halved, with about the automatic number of Gaussians after that."""


def cells_of(size: SetupSize) -> list[Cell]:
    """Cells of every rock, with its dataset and prior."""
    cells: list[Cell] = []
    for rock in size.rocks:
        case = case_of(rock, SETUPS["hemisphere"], size)
        how: dict[str, Any] = {"about": {}, "choices": size.images - SEEDS}
        cells += case.with_task(f"couplings/{rock.name}", f"{__name__}:run", True, **how)
    return cells


def halved(frame: mgs.Frame) -> mgs.Frame:
    """A frame of half the width and height, each pixel a mean of four."""
    whole, camera = captured(frame), frame.camera
    height, width = camera.height // 2, camera.width // 2

    def mean(image: np.ndarray) -> np.ndarray:
        return image.reshape(height, 2, width, 2, -1).mean(axis=(1, 3), dtype=np.float32)

    rgba, K = mean(whole.rgba), np.diag([0.5, 0.5, 1]) @ camera.K
    small = mgs.Camera(K, width, height, camera.world_to_camera)
    whole = replace(whole, camera=small, pixels=mean(whole.pixels), z=whole.z[::2, ::2])
    return replace(whole, rgba=rgba, rock=rgba[..., 3] >= 0.5)


def run(root: Path, out: Path, dataset: str, prior: str, choices: int) -> dict[str, list[Row]]:
    """Task: a row for each of POLICIES, with means over the choices.

    psnr: of the test views after the run, dB; over: less that by the whole matrix. seconds: CPU
    time of a choice. At the steps of the run by the whole matrix, over the candidates: ratio, gain
    over that of the whole matrix; spearman, correlation of the two; kept, share of the largest
    whole gain that the choice keeps.
    """
    whole, tests, _ = shared_scene(root / dataset, root / prior, None)
    data = replace(whole.dataset, frames=tuple(map(halved, whole.dataset.frames)))
    scene = mgs.Scene(data, whole.prior)
    pool, rows = range(0, len(scene.frames), EVERY), list[Row]()
    first = mgs.learn(scene, scene.seeds(SEEDS, pool))
    gains: list[dict[str, np.ndarray]] = []
    for name, policy in POLICIES.items():
        state, seconds = first, 0.0
        for _ in range(choices):
            views = [i for i in pool if i not in state.taken]
            began = time.process_time()
            own = policy(scene, state, views)
            seconds += (time.process_time() - began) / choices
            if name == WHOLE:
                others = {n: p(scene, state, views) for n, p in POLICIES.items() if n != WHOLE}
                gains.append({**others, WHOLE: own})
            state = mgs.learn(scene, (*state.taken, views[int(own.argmax())]), state)
        model = fit_views(scene, scene.frames, state.taken)[0].gaussians
        psnr = float(tests(model)["psnr"].mean())
        rows.append({"policy": name, "psnr": psnr, "seconds": seconds, "taken": str(state.taken)})
    for row in rows:
        pairs = [(step[row["policy"]], step[WHOLE]) for step in gains]
        row["over"] = row["psnr"] - rows[-1]["psnr"]
        row["ratio"] = float(np.mean([(gain / whole).mean() for gain, whole in pairs]))
        row["spearman"] = float(np.mean([spearmanr(*pair).statistic for pair in pairs]))
        kept = [whole[gain.argmax()] / whole.max() for gain, whole in pairs]
        row["kept"] = float(np.mean(kept))
    return {"rows": rows}


def tables(rows: list[Row]) -> str:
    """Table of policies; means over scenes with 95 % intervals."""
    columns: dict[str, Any] = {"information": "policy"}
    columns |= {"gain over that of the whole matrix": scene_mean("ratio", ".2f")}
    columns |= {"Spearman": scene_mean("spearman", ".2f")}
    columns |= {"the choice keeps": scene_mean("kept", ".1%")}
    columns |= {"PSNR over it (dB)": scene_mean("over", "+.2f")}
    columns |= {"CPU s a choice": scene_mean("seconds", ".2f", ends=False)}
    return table(columns, grouped(rows, "policy"))


def write(work: Work) -> list[Path]:
    """Write couplings.csv, .json and .md."""
    rows = work.rows()
    return write_table(work, "couplings", rows, tables(rows))


STUDY = Study("couplings", __doc__, write, SIZES, cells_of, ROCKS | WORKERS, sized)

if __name__ == "__main__":
    study_of("couplings")()
