"""Times of mgs and of gsplat 1.5.3 on one GPU, of the scene of `mgs bench`.

    MGS_VARIANT=cuda_ad_rgb python benchmarks/gsplat_times.py GAUSSIANS WIDTH HEIGHT

Prints the difference of the images and medians of three alternating rounds, milliseconds.
"""

import sys
import time

import drjit as dr
import gsplat
import mitsuba as mi
import numpy as np
import torch

from mgs import runtime

runtime.start()
from mgs.bench import surface_camera, surface_gaussians, time_core  # noqa: E402
from mgs.colour import SH_C0  # noqa: E402
from mgs.splat import as_drjit, render  # noqa: E402

count, width, height = map(int, sys.argv[1:4])
model = surface_gaussians(count)
camera = surface_camera(model, width, height)


def tensor(values):
    return torch.tensor(np.asarray(values), dtype=torch.float32, device="cuda")


parts = {
    "means": tensor(model.means),
    "quats": tensor(model.quats),
    "scales": tensor(np.exp(model.log_scales)),
    "opacities": tensor(model.opacities),
    "colors": tensor(0.5 + SH_C0 * model.sh[:, 0]),
}
learned = [parts[name] for name in ("quats", "scales", "opacities", "colors")]
view, K = tensor(camera.world_to_camera)[None], tensor(camera.K)[None]
weights = tensor(np.random.default_rng(0).normal(size=(height, width, 3)))


def drawn():
    return gsplat.rasterization(
        **parts, viewmats=view, Ks=K, width=width, height=height, packed=False
    )[0][0]


def forward():
    with torch.no_grad():
        drawn()


def gradient():
    for part in learned:
        part.requires_grad_(True)
        part.grad = None
    (drawn() * weights).sum().backward()
    for part in learned:
        part.requires_grad_(False)


def median(call, repeats=21):
    seconds = []
    for _ in range(repeats + 3):
        torch.cuda.synchronize()
        began = time.perf_counter()
        call()
        torch.cuda.synchronize()
        seconds.append(time.perf_counter() - began)
    return float(np.median(seconds[3:]))


difference = np.asarray(render(as_drjit(model), camera).rgb) - drawn().detach().cpu().numpy()
print(f"images differ by {-10 * np.log10((difference**2).mean()):.1f} dB", mi.variant())
rounds: dict[str, list[float]] = {}
for _ in range(3):
    found = time_core(model, camera, 15)
    dr.sync_thread()
    found |= {"gsplat forward": median(forward), "gsplat gradient": median(gradient)}
    for name, seconds in found.items():
        rounds.setdefault(name, []).append(1e3 * seconds)
for name, milliseconds in rounds.items():
    print(f"{name:16s} {np.median(milliseconds):.2f} ms")
