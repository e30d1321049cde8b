"""3DGS of mgs, or gsplat's with its DefaultStrategy, over 30,000 steps from the same random points.

    mgs import nerf_synthetic/lego --test-every 8 --up 0,0,1 --out lego
    MGS_VARIANT=cuda_ad_rgb python benchmarks/gsplat_lego.py lego mgs
    MGS_VARIANT=cuda_ad_rgb python benchmarks/gsplat_lego.py lego gsplat

Prints PSNR on the test views over black, and the number of Gaussians, after some steps. Both have
the rates and the density control of Kerbl et al. 2023. gsplat blends in sRGB.
"""

import math
import sys
import time
from pathlib import Path

import numpy as np

from mgs import runtime

runtime.start()
from mgs.camera import extent_of  # noqa: E402
from mgs.colour import SH_C0, srgb_from_linear  # noqa: E402
from mgs.data.dataset import load_dataset, target_of  # noqa: E402
from mgs.fit import fitting  # noqa: E402
from mgs.fit.settings import TrainSettings, as_3dgs  # noqa: E402
from mgs.prior.initial import round_gaussians  # noqa: E402
from mgs.prior.scattered import scattered  # noqa: E402
from mgs.prior.settings import PriorSettings  # noqa: E402
from mgs.splat import render  # noqa: E402
from mgs.study.case import test_views_of  # noqa: E402

STEPS, MARKS = 30_000, [1000, 3000, 7000, 10_000, 15_000, 20_000, 30_000]
folder, which = Path(sys.argv[1]), sys.argv[2]
data = load_dataset(folder)
frames, tests = list(data.frames), list(test_views_of(data).frames)
cameras = [frame.camera for frame in frames]
extent = extent_of(cameras)
points = scattered(data, PriorSettings(gaussians=100_000, seed=0))[1]
start = round_gaussians(points, frames)[0]


def seen(frame):
    """The object over black, sRGB of 8 bits."""
    return np.round(255 * srgb_from_linear(frame.target()[0][..., :3])) / 255


truth = [seen(frame) for frame in tests]
began = time.perf_counter()


def report(step, images, count):
    errors = [((image - true) ** 2).mean() for image, true in zip(images, truth, strict=True)]
    psnr = -10 * np.mean(np.log10(errors))
    seconds = time.perf_counter() - began
    print(f"{which} step {step}: {psnr:.2f} dB, {count} Gaussians, {seconds:.0f} s", flush=True)


def ours():
    images, own, marks = len(frames), fitting._pass, list(MARKS)
    settings = TrainSettings(**as_3dgs(extent), passes=round(STEPS / images), most_gaussians=2**21)

    def draw(model):
        for frame in tests:
            linear = np.asarray(render(model, frame.camera).rgb)
            yield srgb_from_linear(np.clip(linear, 0, 1))

    def passed(goal, optimiser, model, order, *others):
        found = own(goal, optimiser, model, order, *others)
        if marks and others[-1] + images >= marks[0]:
            report(others[-1] + images, draw(found[0]), len(found[0]))
            marks.pop(0)
        return found

    fitting._pass = passed
    targets = [target_of(frame) for frame in frames]
    fitting.fit(start.with_degree(3), cameras, targets, settings)


def gsplats():
    import gsplat
    import torch
    from torch.nn.functional import conv2d

    def tensor(values):
        return torch.tensor(np.asarray(values), dtype=torch.float32, device="cuda")

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
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimisers["means"], 0.01 ** (1 / STEPS))
    strategy = gsplat.DefaultStrategy(refine_stop_iter=STEPS // 2)
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

    def draw(camera, degree):
        return gsplat.rasterization(
            parts["means"],
            parts["quats"],
            torch.exp(parts["scales"]),
            torch.sigmoid(parts["opacities"]),
            torch.cat([parts["sh0"], parts["shN"]], 1),
            tensor(camera.world_to_camera)[None],
            tensor(camera.K)[None],
            camera.width,
            camera.height,
            sh_degree=degree,
            packed=False,
        )

    targets, order = [tensor(seen(frame)) for frame in frames], []
    shuffle = torch.Generator().manual_seed(0)
    for step in range(STEPS):
        order = order or torch.randperm(len(frames), generator=shuffle).tolist()
        i = order.pop()
        image, _, info = draw(cameras[i], min(step // 1000, 3))
        strategy.step_pre_backward(parts, optimisers, state, step, info)
        a, b = image.permute(0, 3, 1, 2), targets[i].permute(2, 0, 1)[None]
        (0.8 * (a - b).abs().mean() + 0.2 * (1 - ssim(a, b))).backward()
        for optimiser in optimisers.values():
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        schedule.step()
        strategy.step_post_backward(parts, optimisers, state, step, info, packed=False)
        if step + 1 in MARKS:
            with torch.no_grad():
                images = [draw(f.camera, 3)[0][0].clamp(0, 1).cpu().numpy() for f in tests]
            report(step + 1, images, len(parts["means"]))


ours() if which == "mgs" else gsplats()
