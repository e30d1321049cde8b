"""Quality and cost of frames by samples per pixel, plain and denoised.

`python benchmarks/denoiser.py` renders three views of a hemisphere around each of four rocks,
320x240, and two seeds of each setting. PSNR is of sRGB values against 504 samples per pixel, in the
full frame and on the rock; CPU seconds are a frame's.
"""

import resource

import numpy as np

from mgs import runtime

runtime.start()

from mgs.colour import srgb_from_linear  # noqa: E402
from mgs.metrics import psnr  # noqa: E402
from mgs.synth import scene  # noqa: E402
from mgs.synth.orbit import rock_cameras  # noqa: E402
from mgs.synth.rendering import _meter, rock_of  # noqa: E402
from mgs.synth.scene_file import load_scene_file  # noqa: E402

SCENES, VIEWS, SEEDS = ("boulder", "obsidian", "pebbles", "strata"), (3, 13, 23), (5, 6)

SETTINGS = [(spp, quality) for quality in ("none", "balanced") for spp in (4, 6, 8, 12, 16, 36)]


def cpu() -> float:
    """CPU seconds of this process so far."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Print a line for each scene and setting."""
    for name in SCENES:
        settings = load_scene_file(name)
        orbit = settings.orbit.model_copy(update={"kind": "hemisphere", "distances": (1, 1.5, 2)})
        settings = settings.model_copy(update={"orbit": orbit})
        rock, _ = rock_of(settings, 1, None, None)
        cameras = rock_cameras(settings, (320, 240), 32, rock)
        world = scene.MitsubaScene(settings, rock, cameras[0], 1)
        exposure = _meter(world, cameras, 1, 8, True, print)

        def srgb(linear: np.ndarray, gain: float = exposure) -> np.ndarray:
            return srgb_from_linear(np.clip(linear * gain, 0, 1))

        truth = {}
        for view in VIEWS:
            many = [world.render(cameras[view], 168, 1000 + k, False) for k in range(3)]
            truth[view] = [np.mean([getattr(m, of) for m in many], 0) for of in ("rgb", "rock")]
        for spp, quality in SETTINGS:
            found, seconds = [], 0.0
            for view in VIEWS:
                for seed in SEEDS:
                    start = cpu()
                    frame = world.render(cameras[view], spp, seed, quality != "none")
                    seconds += cpu() - start
                    whole, alone = truth[view]
                    found.append(
                        [
                            psnr(srgb(frame.rgb), srgb(whole)),
                            psnr(srgb(frame.rock[..., :3]), srgb(alone[..., :3]), frame.mask),
                        ]
                    )
            full, on_rock = np.mean(found, 0)
            line = f"{name} {spp} {quality}: {full:.2f} {on_rock:.2f} dB"
            print(f"{line}, {seconds / len(found):.2f} CPU s", flush=True)


if __name__ == "__main__":
    main()
