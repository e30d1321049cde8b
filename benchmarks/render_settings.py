"""Measure PSNR and CPU seconds of a frame against samples per pixel, with and without denoising.

    python benchmarks/render_settings.py OUT.json

Two views of the default scene, 640x480, against a reference of 1024 samples. Rows also have PSNR at
the rock's outline, the pixels that it covers in part: of the rock alone in front of black, and of
the image times the binary mask.
"""

from __future__ import annotations

import os
import sys
import time
from typing import Any

import numpy as np

from mgs import runtime
from mgs.colour import srgb_from_linear
from mgs.files import write_json
from mgs.metrics import psnr
from mgs.provenance import command_line, versions
from mgs.seeds import generator

SPP = (2, 4, 8, 16, 32, 64)
REFERENCE_SPP = 1024
SIZE = (640, 480)
VIEWS = (2, 17)
"""Views of a circle of 32: the first looks along the sun, the second against it."""


def measure() -> list[dict[str, Any]]:
    """Render each setting; times are medians over the views after one warm-up frame."""
    runtime.start()
    from mgs.synth.orbit import rock_cameras
    from mgs.synth.rendering import ROCK_EXPOSURE
    from mgs.synth.rock import make_rock
    from mgs.synth.scene import MitsubaScene
    from mgs.synth.scene_file import load_scene_file

    settings = load_scene_file("boulder")
    rock = make_rock(settings.rock, generator(0, "rock"))
    cameras = rock_cameras(settings, SIZE, 32, rock)
    scene = MitsubaScene(settings, rock, cameras[0], 0)

    def reference(view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        seeds = range(1000, 1000 + REFERENCE_SPP // 64)
        parts = [scene.render(cameras[view], 64, seed, denoise=False) for seed in seeds]
        rgb, alone = (np.mean([getattr(p, name) for p in parts], 0) for name in ("rgb", "rock"))
        return rgb, alone, parts[0].mask

    truth = {view: reference(view) for view in VIEWS}
    exposure = ROCK_EXPOSURE / np.mean([rgb[mask].mean() for rgb, _, mask in truth.values()])

    def shown(rgb: np.ndarray) -> np.ndarray:
        return srgb_from_linear(rgb * exposure)

    def compare(rendered: Any, rgb: np.ndarray, alone: np.ndarray, mask: np.ndarray) -> dict:
        image, expected, black = shown(rendered.rgb), shown(rgb), shown(alone[..., :3])
        outline = (alone[..., 3] > 0) & (alone[..., 3] < 1)
        return {
            "psnr": psnr(image, expected),
            "psnr_rock": psnr(image, expected, mask),
            "psnr_outline": psnr(shown(rendered.rock[..., :3]), black, outline),
            "psnr_outline_image_times_mask": psnr(image * mask[..., None], black, outline),
        }

    rows = []
    for denoise, spp in ((denoise, spp) for denoise in (False, True) for spp in SPP):
        scene.render(cameras[0], spp, 0, denoise)
        clocks, found = [], []
        for view, expected in truth.items():
            begun = time.perf_counter(), time.process_time()
            rendered = scene.render(cameras[view], spp, 7, denoise)
            clocks.append((time.perf_counter() - begun[0], time.process_time() - begun[1]))
            found.append(compare(rendered, *expected))
        seconds, cpu = np.round(np.median(clocks, 0), 3).tolist()
        row = {"spp": spp, "denoise": denoise, "seconds": seconds, "cpu_seconds": cpu}
        row |= {key: round(float(np.mean([one[key] for one in found])), 2) for key in found[0]}
        rows.append(row)
        print(row, flush=True)
    return rows


if __name__ == "__main__":
    rows = measure()
    machine = runtime.processor() | {"cores": os.cpu_count()}
    made = {"command": command_line(), "machine": machine, "versions": versions()}
    size = {"reference_spp": REFERENCE_SPP, "size": SIZE}
    write_json(sys.argv[1], made | size | {"settings": rows})
