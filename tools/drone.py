"""A simulated drone for `mgs nbv --capture-command`: Mitsuba renders the picture of a pose.

    mgs synth-orbit WORLD --on-demand
    mgs nbv WORLD --capture-command 'python tools/drone.py WORLD {pose} {out} --fail 0.2' --out RUN

It flies to the pose with an error, and writes what it saw: the picture, the pose flown, depth and
mask. A share of the flights fails in one of the ways of FAILURES. Pose and try decide everything.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from mgs import runtime
from mgs.camera import Camera, opencv_from_opengl, opengl_from_opencv
from mgs.images import write_exr, write_png
from mgs.seeds import derive_seed, generator

FAILURES = ("crash", "hang", "nothing", "half", "size", "white", "blur", "astray")


def flown(asked: Camera, noise: float, rng: np.random.Generator) -> Camera:
    """Camera at a pose with an error: `noise` metres, and as many tenths of a radian."""
    shake = np.eye(4)
    shake[:3, :3] = Rotation.from_rotvec(0.1 * noise * rng.standard_normal(3)).as_matrix()
    shake[:3, 3] = noise * rng.standard_normal(3)
    return Camera(asked.K, asked.width, asked.height, shake @ asked.world_to_camera)


def photograph(world: Path, asked: dict, out: Path, noise: float, failure: str, seed: int) -> None:
    """Fly to a pose and write the answer, spoiled by a failure."""
    if failure == "crash":
        sys.exit("the drone lost its radio link")
    if failure == "hang":
        time.sleep(3600)
    if failure == "nothing":
        return
    runtime.start()
    from mgs.synth.capture import photographer_of  # needs a variant

    K = np.array([[asked["fl_x"], 0, asked["cx"]], [0, asked["fl_y"], asked["cy"]], [0, 0, 1]])
    pose = opencv_from_opengl(asked["transform_matrix"])
    camera = Camera(K, asked["w"], asked["h"], pose)
    camera = flown(camera, noise if failure != "astray" else 30.0, generator(seed, asked["name"]))
    photographer, _, _ = photographer_of(world)
    spp, draw = photographer.spp, derive_seed(seed, asked["name"])
    rendered = photographer.scene.render(camera, spp, draw, photographer.denoise)
    rgb = np.asarray(rendered.rgb) * photographer.exposure
    rgb = {"white": rgb + 1, "blur": gaussian_filter(rgb, (6, 6, 0))}.get(failure, rgb)
    matrix = opengl_from_opencv(camera.world_to_camera).tolist()
    stem = out.with_suffix("")
    stem.with_suffix(".flown.json").write_text(json.dumps({"transform_matrix": matrix}))
    write_exr(stem.with_suffix(".depth.exr"), {"Z": rendered.depth})
    write_png(stem.with_suffix(".mask.png"), rendered.mask)
    write_png(out, rgb[::2, ::2] if failure == "size" else rgb)
    if failure == "half":
        out.write_bytes(out.read_bytes()[: out.stat().st_size // 2])


def main() -> None:
    """Read the options and fly."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("world", type=Path, help="dataset of `mgs synth-orbit --on-demand`")
    options.add_argument("pose", type=Path)
    options.add_argument("out", type=Path)
    options.add_argument("--noise", type=float, default=0.02, help="error of the pose, metres")
    options.add_argument("--fail", type=float, default=0.0, help="share of flights that fail")
    options.add_argument("--seed", type=int, default=0)
    given = options.parse_args()
    asked = json.loads(given.pose.read_text())
    luck = generator(given.seed, f"{asked['name']}/{asked['attempt']}")
    failure = str(luck.choice(FAILURES)) if luck.random() < given.fail else ""
    photograph(given.world, asked, given.out, given.noise, failure, given.seed)


if __name__ == "__main__":
    main()
