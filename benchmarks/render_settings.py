"""Which samples per pixel, with or without denoising? PSNR against a 1024-sample reference over CPU
seconds per frame.

    python benchmarks/render_settings.py docs/benchmarks

Two views of the default scene (sunlit and shaded), 640x480. At the rock's outline (the pixels that
it covers in part) the picture of the rock alone is compared, in front of black, and so is the image
times the binary mask. Writes render_settings.json and render_settings.png; with --plot-only, draws
the figure again from the JSON.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

import numpy as np

from mgs import runtime
from mgs.files import read_json, write_json

SPP = (2, 4, 8, 16, 32, 64)
REFERENCE_SPP = 1024
SIZE = (640, 480)
VIEWS = (2, 17)
"""Of a circle of 32: the first looks along the sun, the second against it."""


def measure() -> dict:
    """Render every setting; times are medians over the views after one warm-up frame."""
    runtime.start()
    from mgs.colour import srgb_from_linear
    from mgs.metrics import psnr
    from mgs.provenance import command_line, versions
    from mgs.seeds import generator
    from mgs.synth.rendering import ROCK_EXPOSURE, Preset, rock_cameras
    from mgs.synth.rock import make_rock
    from mgs.synth.scene import Scene
    from mgs.synth.scene_file import load_scene_file

    settings = load_scene_file("boulder")
    rock = make_rock(settings.rock, generator(0, "rock"))
    cameras = rock_cameras(settings, Preset(*SIZE, 32, 1), rock)
    scene = Scene(settings, rock, cameras[0], 0)

    def reference(index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        parts = [
            scene.render(cameras[index], 64, 1000 + i, denoise=False)
            for i in range(REFERENCE_SPP // 64)
        ]
        return (
            np.mean([part.rgb for part in parts], axis=0),
            np.mean([part.rock for part in parts], axis=0),
            parts[0].mask,
        )

    truth = {index: reference(index) for index in VIEWS}
    exposure = ROCK_EXPOSURE / np.mean([rgb[mask].mean() for rgb, _, mask in truth.values()])

    def shown(rgb: np.ndarray) -> np.ndarray:
        return srgb_from_linear(rgb * exposure)

    rows = []
    for denoise in (False, True):
        for spp in SPP:
            scene.render(cameras[0], spp, 0, denoise)
            seconds, cpu, found = [], [], []
            for index, (rgb, rock, mask) in truth.items():
                begun, cpu_begun = time.perf_counter(), time.process_time()
                rendered = scene.render(cameras[index], spp, 7, denoise)
                seconds.append(time.perf_counter() - begun)
                cpu.append(time.process_time() - cpu_begun)
                image, expected, alone = shown(rendered.rgb), shown(rgb), shown(rock[..., :3])
                outline = (rock[..., 3] > 0) & (rock[..., 3] < 1)
                found.append(
                    {
                        "psnr": psnr(image, expected),
                        "psnr_rock": psnr(image, expected, mask),
                        "psnr_outline": psnr(shown(rendered.rock[..., :3]), alone, outline),
                        "psnr_outline_image_times_mask": psnr(
                            image * mask[..., None], alone, outline
                        ),
                    }
                )
            rows.append(
                {
                    "spp": spp,
                    "denoise": denoise,
                    "seconds": round(float(np.median(seconds)), 3),
                    "cpu_seconds": round(float(np.median(cpu)), 3),
                }
                | {key: round(float(np.mean([view[key] for view in found])), 2) for key in found[0]}
            )
            print(rows[-1], flush=True)
    return {
        "command": command_line(),
        "machine": runtime.processor() | {"cores": os.cpu_count()},
        "versions": versions(),
        "reference_spp": REFERENCE_SPP,
        "size": SIZE,
        "settings": rows,
    }


def plot(data: dict, path: Path) -> None:
    """PSNR of the rock's pixels over CPU seconds of all cores together, so that other work on the
    machine does not count."""
    import matplotlib

    from mgs.plotting import STYLE, new_figure, save_figure

    with matplotlib.rc_context(STYLE):
        figure = new_figure(6.4, 4, dpi=130)
        axes = figure.subplots()
        for denoise, label, colour in (
            (True, "denoised (albedo and normal guides)", "#0072B2"),
            (False, "plain", "#D55E00"),
        ):
            rows = [row for row in data["settings"] if row["denoise"] == denoise]
            x, y = [row["cpu_seconds"] for row in rows], [row["psnr_rock"] for row in rows]
            axes.plot(x, y, "o-", color=colour, label=label)
            for row, at in zip(rows, zip(x, y, strict=True), strict=True):
                axes.annotate(
                    str(row["spp"]),
                    at,
                    textcoords="offset points",
                    xytext=(0, 7),
                    ha="center",
                    fontsize=8,
                )
        axes.set(
            xscale="log",
            xlabel="CPU seconds per frame (all cores together)",
            ylabel=f"PSNR on the rock against {data['reference_spp']} spp (dB)",
        )
        axes.margins(y=0.1)
        size, cores = "x".join(map(str, data["size"])), data["machine"]["cores"]
        axes.set_title(f"boulder, {size}, {cores} cores; numbers are spp")
        axes.legend()
        save_figure(figure, path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--plot-only", action="store_true")
    arguments = parser.parse_args()
    json_path = arguments.out / "render_settings.json"
    if not arguments.plot_only:
        write_json(json_path, measure())
    plot(read_json(json_path), arguments.out / "render_settings.png")
