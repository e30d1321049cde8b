"""PSNR over seconds of `mgs fit` and of gsplat's DefaultStrategy, from the samples of one prior.

    MGS_VARIANT=cuda_ad_rgb python benchmarks/gsplat_fits.py DATASET PRIOR mgs:30 gsplat:3000 ...

The numbers are passes of mgs and steps of gsplat. Prints a line for each fit: seconds of the whole
fit, and PSNR on the test views, in the full frame and in the masks. gsplat has the rates and the
loss of Kerbl et al. 2023, their schedule scaled to its steps, and starts from round Gaussians. It
blends in sRGB. The first fit of each program also compiles kernels.
"""

import math
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from mgs import runtime

runtime.start()
from mgs.camera import extent_of  # noqa: E402
from mgs.colour import SH_C0, srgb_from_linear  # noqa: E402
from mgs.data.dataset import load_dataset  # noqa: E402
from mgs.metrics import psnr  # noqa: E402
from mgs.prior.build import load_prior  # noqa: E402
from mgs.prior.initial import round_gaussians  # noqa: E402
from mgs.run.nbv import resume_nbv, start_fit  # noqa: E402
from mgs.splat import as_drjit, render  # noqa: E402
from mgs.study.case import test_views_of  # noqa: E402

folder, prior = Path(sys.argv[1]), Path(sys.argv[2])
data = load_dataset(folder)
frames, tests = list(data.frames), list(test_views_of(data).frames)


def seen(frame):
    """The object over black, sRGB of 8 bits."""
    return np.round(255 * srgb_from_linear(frame.target()[0][..., :3])) / 255


def report(program, seconds, count, images):
    full, masked = [], []
    for frame, image in zip(tests, images, strict=True):
        known = frame.target()[1] > 0
        full.append(psnr(seen(frame), image, known))
        masked.append(psnr(seen(frame), image, known & frame.mask()))
    found = f"{np.mean(full):.2f}, {np.mean(masked):.2f} dB, {count} Gaussians"
    print(f"{folder.name} {program}: {seconds:.1f} s, {found}", flush=True)


def ours(passes):
    with tempfile.TemporaryDirectory() as out:
        began = time.perf_counter()
        run = start_fit(folder, Path(out) / "run", prior=prior, train={"passes": passes})
        model = resume_nbv(run).state.gaussians
        seconds = time.perf_counter() - began
    drawn = as_drjit(model)
    linear = (np.asarray(render(drawn, frame.camera).rgb) for frame in tests)
    images = (srgb_from_linear(np.clip(image, 0, 1)) for image in linear)
    report(f"mgs, {passes} passes", seconds, len(model), images)


def gsplats(steps):
    import gsplat
    import torch
    from torch.nn.functional import conv2d

    def tensor(values):
        return torch.tensor(np.asarray(values), dtype=torch.float32, device="cuda")

    began, scale = time.perf_counter(), steps / 30_000
    extent = extent_of([frame.camera for frame in frames])
    start = round_gaussians(load_prior(prior).points, frames)[0]
    srgb = srgb_from_linear(np.clip(0.5 + SH_C0 * start.sh, 0, 1))
    values = {
        "means": start.means,
        "scales": start.log_scales,
        "quats": start.quats,
        "opacities": start.logit_opacities,
        "sh0": (srgb - 0.5) / SH_C0,
        "shN": np.zeros((len(start), 15, 3)),
    }
    rates = {"means": 1.6e-4 * extent, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2}
    rates |= {"sh0": 2.5e-3, "shN": 2.5e-3 / 20}
    parts = torch.nn.ParameterDict(
        {name: torch.nn.Parameter(tensor(value)) for name, value in values.items()}
    )
    optimisers = {
        name: torch.optim.Adam(
            [{"params": parts[name], "lr": rate, "name": name}], eps=1e-15, fused=True
        )
        for name, rate in rates.items()
    }
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimisers["means"], 0.01 ** (1 / steps))
    strategy = gsplat.DefaultStrategy(
        refine_start_iter=int(500 * scale),
        refine_stop_iter=int(15_000 * scale),
        reset_every=max(int(3000 * scale), 1),
        refine_every=max(int(100 * scale), 1),
    )
    state = strategy.initialize_state(scene_scale=extent)
    window = tensor([math.exp(-((i - 5) ** 2) / 4.5) for i in range(11)])
    window /= window.sum()

    def blurred(x):
        count = x.shape[1]
        down = window.view(1, 1, 11, 1).expand(count, 1, 11, 1).contiguous()
        across = window.view(1, 1, 1, 11).expand(count, 1, 1, 11).contiguous()
        x = conv2d(x, down, padding=(5, 0), groups=count)
        return conv2d(x, across, padding=(0, 5), groups=count)

    def ssim(a, b):
        u, v, uu, vv, uv = blurred(torch.cat([a, b, a * a, b * b, a * b], 1)).chunk(5, 1)
        same = (2 * u * v + 1e-4) * (2 * (uv - u * v) + 9e-4)
        return (same / ((u * u + v * v + 1e-4) * (uu - u * u + vv - v * v + 9e-4))).mean()

    cameras = {
        frame.name: (tensor(frame.camera.world_to_camera)[None], tensor(frame.camera.K)[None])
        for frame in frames + tests
    }

    def draw(frame, degree):
        return gsplat.rasterization(
            parts["means"],
            parts["quats"],
            torch.exp(parts["scales"]),
            torch.sigmoid(parts["opacities"]),
            torch.cat([parts["sh0"], parts["shN"]], 1),
            *cameras[frame.name],
            frame.camera.width,
            frame.camera.height,
            sh_degree=degree,
            packed=False,
        )

    weights = [tensor(frame.target()[1])[..., None] for frame in frames]
    targets = [tensor(seen(frame)) * weight for frame, weight in zip(frames, weights, strict=True)]
    order, shuffle = [], torch.Generator().manual_seed(0)
    for step in range(steps):
        order = order or torch.randperm(len(frames), generator=shuffle).tolist()
        i = order.pop()
        image, _, info = draw(frames[i], min(int(step / (1000 * scale)), 3))
        strategy.step_pre_backward(parts, optimisers, state, step, info)
        a, b = (image * weights[i]).permute(0, 3, 1, 2), targets[i].permute(2, 0, 1)[None]
        (0.8 * (a - b).abs().mean() + 0.2 * (1 - ssim(a, b))).backward()
        for optimiser in optimisers.values():
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        schedule.step()
        strategy.step_post_backward(parts, optimisers, state, step, info, packed=False)
    torch.cuda.synchronize()
    seconds = time.perf_counter() - began
    with torch.no_grad():
        images = [draw(frame, 3)[0][0].clamp(0, 1).cpu().numpy() for frame in tests]
    report(f"gsplat, {steps} steps", seconds, len(parts["means"]), images)


for word in sys.argv[3:]:
    which, count = word.split(":")
    (ours if which == "mgs" else gsplats)(int(count))
