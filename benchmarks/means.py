"""What learned means buy: `python benchmarks/means.py DATASET PREFIX [GAUSSIANS PASSES]` writes
PREFIX.json and PREFIX.png.

Fits with means that are frozen, that move along the prior's normals, and that are free, from priors
of several errors: noise is added to the points that the prior's mesh is built from, in spacings of
its samples; the crudest prior is the visual hull of the masks, which fills every hollow. Each is
fitted to 12 and to 4 views spread evenly in azimuth, at default settings
otherwise, and judged on the test views: PSNR inside the rock.
Where the dataset has the true rock (rock.glb), the mean distance from it is measured too, of the
means that lie on the surface, before and after the fit; 5,000 Gaussians and the default number of
passes unless said.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.data.dataset import load_dataset, target_of
from mgs.data.meshes import distances_to_mesh, read_rock
from mgs.files import write_json
from mgs.fit.settings import TrainSettings
from mgs.plotting import STYLE, new_figure, save_figure
from mgs.policy.poses import seed_views
from mgs.prior.build import build_prior
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.report.evaluation import evaluate
from mgs.run.operations import operations_of
from mgs.run.settings import NbvSettings
from mgs.splat import MEANS

GAUSSIANS, VIEWS, NOISES, HULL = 5_000, (12, 4), (0.0, 0.5, 1.5), "hull"
"""HULL stands among the priors in the place of a noise."""


def study(root: Path, gaussians: int, passes: int) -> list[dict[str, Any]]:
    """One record per fit: views, noise in spacings or HULL, means; the PSNR, dB, the last loss, and
    the distances, metres."""
    dataset = load_dataset(root)
    tests = dataset.test_views().frames
    frames, records = dataset.frames, []
    true = read_rock(root / "rock.glb") if (root / "rock.glb").is_file() else None
    exact, _ = build_prior(dataset, PriorSettings(gaussians=gaussians))
    positions = np.array([frame.camera.position for frame in frames])
    taken = {views: seed_views(positions, exact.points.mean(0), views) for views in VIEWS}
    priors = {
        noise: PriorSettings(gaussians=gaussians, noise=noise * exact.spacing) for noise in NOISES
    }
    for noise in (*NOISES, HULL):
        if noise == HULL:
            prior = build_prior(dataset, PriorSettings(gaussians=gaussians), source="hull")[0]
        else:
            prior = exact if noise == 0 else build_prior(dataset, priors[noise])[0]
        for views in VIEWS:
            chosen = [frames[i] for i in taken[views]]
            cameras, targets = (
                [frame.camera for frame in chosen],
                [target_of(frame) for frame in chosen],
            )
            for means in MEANS:
                train = TrainSettings(means=means, passes=passes)
                settings = NbvSettings(dataset=root, prior=root, train=train).with_spacing(
                    prior.spacing
                )
                stations = operations_of(dataset, prior, settings)
                start = stations.initial(chosen)
                fit = stations.fit(
                    start, start, cameras, targets, settings.train, lambda done, most: None
                )
                quality = evaluate(fit.gaussians, [], [], test_frames=tests)["test"]
                record = {
                    "views": views,
                    "noise": noise,
                    "means": means,
                    "spacing": prior.spacing,
                    "loss": fit.loss,
                }
                record |= {name: quality[name] for name in ("psnr", "psnr_inside")}
                if true is not None:
                    for name, model in (
                        ("distance_before", start),
                        ("distance_after", fit.gaussians),
                    ):
                        points = model.means[: len(prior.points)].astype(np.float64)
                        record[name] = float(
                            distances_to_mesh(points, true.vertices, true.faces).mean()
                        )
                records.append(record)
                print(record, flush=True)
    return records


def draw(path: Path, records: list[dict[str, Any]]) -> None:
    """PSNR against the noise, a panel for each number of views; where it was measured, the distance
    from the true rock too."""
    import matplotlib

    measured = "distance_after" in records[0]
    with matplotlib.rc_context(STYLE):
        figure = new_figure(7.2, 5.2 if measured else 2.8)
        axes = figure.subplots(1 + measured, len(VIEWS), sharex=True, sharey="row", squeeze=False)
        for column, views in enumerate(VIEWS):
            for means, colour, marker in zip(
                MEANS, ("#0072B2", "#009E73", "#D55E00"), "os^", strict=True
            ):
                shown = [r for r in records if (r["views"], r["means"]) == (views, means)]
                line = {"color": colour, "marker": marker, "label": means}
                noisy = [
                    r for r in shown if r["noise"] != "hull"
                ]  # no line leads to the hull, which is another prior
                for some, style in (
                    (noisy, line),
                    ([r for r in shown if r not in noisy], line | {"label": None}),
                ):
                    noises = [f"{r['noise']}" for r in some]
                    axes[0, column].plot(noises, [r["psnr_inside"] for r in some], **style)
                    if measured:
                        axes[1, column].plot(
                            noises, [1000 * r["distance_after"] for r in some], **style
                        )
            axes[0, column].set_title(f"{views} views")
            axes[-1, column].set(xlabel="noise of the prior's points (spacings), or its hull")
        axes[0, 0].set(ylabel="PSNR inside, test views (dB)")
        if measured:
            axes[1, 0].set(ylabel="means from the true rock (mm)")
            axes[1, 0].set_ylim(bottom=0)
        axes[0, 0].legend(title="means")
        save_figure(figure, path)


def main(
    root: Path, prefix: Path, gaussians: int = GAUSSIANS, passes: int = TrainSettings().passes
) -> None:
    """Measure, write, draw."""
    runtime.start()
    records = study(root, gaussians, passes)
    made = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    write_json(
        prefix.with_suffix(".json"),
        made | {"gaussians": gaussians, "passes": passes, "records": records},
    )
    draw(prefix.with_suffix(".png"), records)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *map(int, sys.argv[3:]))
