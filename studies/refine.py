"""Does a local search around suggested poses gain more than a denser dome?

    python -m studies.refine OUT boulder strata horseshoe

For each rock: four seeds of a hemisphere, and six views by directional-i, planned among 24 poses of
a dome; then moved by a pattern search (steps of 12, 6 and 3 degrees of azimuth and elevation, eight
directions, all views planned again among the moved poses); and planned among 200 poses. Prints the
criterion's gain, seconds, and PSNR of a fit to all ten images on 24 test views.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

import mgs
from mgs import runtime
from mgs.camera import Camera
from mgs.run.candidates import Named, Site, place_poses
from mgs.run.folder import Run
from mgs.run.policy_file import policy_of
from mgs.run.suggest import _coarse_scene, _settings, suggest, taken_in_order
from mgs.synth.scene_file import load_scene_file

VIEWS, BAND, STEPS = 6, (10.0, 80.0), (12.0, 6.0, 3.0)
MOVES = [(x, y) for x in (-0.7, 0.7) for y in (-0.7, 0.7)] + [(1, 0), (-1, 0), (0, 1), (0, -1)]


def turned(camera: Camera, centre: np.ndarray, azimuth: float, elevation: float) -> Camera:
    """A camera turned rigidly about the upright axis and then upwards about `centre`, degrees."""
    a, e = np.radians([azimuth, elevation])
    x, y, _ = camera.position - centre
    side = np.array([y, -x, 0]) / np.hypot(x, y)
    cross = np.cross(np.eye(3), -side)
    upwards = np.eye(3) + np.sin(e) * cross + (1 - np.cos(e)) * cross @ cross
    R = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]) @ upwards
    pose = camera.camera_to_world
    pose[:3, :3], pose[:3, 3] = R @ pose[:3, :3], centre + R @ (pose[:3, 3] - centre)
    return Camera(camera.K, camera.width, camera.height, np.asarray(np.linalg.inv(pose)))


def planned(run: Run, poses: Sequence[Named]) -> list[Camera]:
    plan = suggest(run, poses, VIEWS, elevations=BAND, policy="directional-i").plan
    return [view.camera for view in plan]


def gains(run: Run, plans: Sequence[Sequence[Camera]]) -> list[float]:
    """Gain of each plan by the criterion."""
    images = taken_in_order(run)
    poses = [(f"{i}", camera) for i, camera in enumerate(chain(*plans))]
    settings = _settings(run, len(images), VIEWS, {"policy": "directional-i"})
    scene, state = _coarse_scene(run, images, poses, settings)
    views = list(range(len(images), len(images) + len(poses)))
    policy: Any = policy_of("directional-i")
    made = policy.relaxation(scene, state, views)
    return [made.gain(range(k * VIEWS, (k + 1) * VIEWS)) for k in range(len(plans))]


def refined(run: Run, plan: list[Camera], centre: np.ndarray) -> list[Camera]:
    """The plan after the pattern search; a round that gains nothing ends its step."""
    for step in STEPS:
        for _ in range(2):
            poses = list(plan)
            for camera in plan:
                x, y, z = camera.position - centre
                wide = 1 / np.cos(min(np.arctan2(z, np.hypot(x, y)), 1.4))
                poses += [turned(camera, centre, dx * step * wide, dy * step) for dx, dy in MOVES]
            new = planned(run, [(f"p{i}", camera) for i, camera in enumerate(poses)])
            before, after = gains(run, [plan, new])
            if after <= before * 1.0001:
                break
            plan = new
    return plan


def quality(run: Run, plan: Sequence[Camera], folder: Path) -> dict[str, float]:
    """PSNR on the test views of a fit to the images of a run and those of a plan."""
    from mgs.synth.capture import photographer_of
    from mgs.synth.rendering import is_done, orbit_frames

    photographer = photographer_of(run.dataset.root)[0]
    frames = orbit_frames(folder, list(plan), folder.name)
    for frame in frames:
        if not is_done(frame):
            photographer.take(frame)
    dataset = replace(run.dataset, frames=(*taken_in_order(run), *frames))
    model = mgs.learn(mgs.Scene(dataset, run.prior), range(len(dataset.frames))).gaussians
    tests = run.dataset.test_views()
    assert tests is not None
    means = mgs.evaluate(model, tests)["all"]
    return {name: means[name] for name in ("psnr", "psnr_mask", "psnr_inside")}


def main(out: Path, name: str) -> None:
    """Print the row of a rock."""
    rock = load_scene_file(name)
    orbit = rock.orbit.model_copy(update={"kind": "hemisphere"})
    rock, root = rock.model_copy(update={"orbit": orbit}), out / name
    preset = mgs.RenderPreset(320, 240, 24, 8)
    dataset = mgs.synth_orbit(root / "data", rock, preset, test_views=24, on_demand=True)
    prior = mgs.build_prior(dataset.root / "survey", gaussians=6000)
    run = mgs.run_nbv(dataset, root / "run", prior=prior, seeds=4, budget=0)
    site, eyes = Site(run.prior, run.taken[-1].camera), [f.camera.position for f in run.taken]
    far = float(np.median(np.linalg.norm(np.array(eyes) - site.centre, axis=1)))
    plans, seconds = dict[str, list[Camera]](), dict[str, float]()
    for label, work in {
        "24 poses": lambda: planned(run, place_poses("dome", 24, far, BAND, site)),
        "moved": lambda: refined(run, plans["24 poses"], site.centre),
        "200 poses": lambda: planned(run, place_poses("dome", 200, far, BAND, site)),
    }.items():
        begun = time.monotonic()
        plans[label], seconds[label] = work(), time.monotonic() - begun
    gain = dict(zip(plans, gains(run, list(plans.values())), strict=True))
    for label, plan in plans.items():
        row = {"rock": name, "plan": label, "gain": gain[label] / gain["24 poses"]}
        row |= {"seconds": seconds[label], **quality(run, plan, root / label.replace(" ", "-"))}
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    runtime.start()
    for rock in sys.argv[2:]:
        main(Path(sys.argv[1]), rock)
