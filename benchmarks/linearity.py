"""How linear is an image in the parameters? `python benchmarks/linearity.py PREFIX NAME=DATASET...`

Writes PREFIX.json, and PREFIX.png, a figure of the first dataset.

The Fisher information stands for the posterior as far as the image h is linear in the parameters
theta over the posterior's width (paper, section III-C). Measured is the departure |h(theta + delta)
- h(theta) - J delta| / |J delta| over views that were not fitted, with J delta from one
forward-mode derivative, for moves delta of two kinds:

- draws from the diagonal posterior, N(0, sigma^2 / (H + lam)), of all parameters that are learned
by default and of one kind at
  a time, and of the means, as if they were free, times a factor;
- the move that one added view really causes when the fit goes on with it, with frozen means and
with free ones.

The same draws are also made in other coordinates (`COORDINATES`): to first order they are the same
moves, with the same J delta and the same information; beyond that the image may be more or less
linear in them.

Models: fitted to four views spread evenly in azimuth for few and for many passes.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import expit
from scipy.special import logit as log_odds

from mgs import runtime
from mgs.camera import Camera
from mgs.data.dataset import Dataset, load_dataset, target_of
from mgs.files import write_json
from mgs.fit.fitting import fit
from mgs.fit.settings import TrainSettings
from mgs.gaussians import KINDS, LEARNED, Gaussians
from mgs.plotting import STYLE, new_figure, save_figure
from mgs.policy.criteria import MEAN_STD, PIXEL_NOISE, lam_by_kind, regularisation
from mgs.policy.poses import seed_views
from mgs.prior.build import Prior, build_prior
from mgs.prior.initial import initial_gaussians
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.run.settings import NbvSettings
from mgs.seeds import generator
from mgs.splat import ListCache, fisher, groups, jvp, render

PASSES = (10, 400)
FACTORS = (0.03, 0.1, 0.3, 1.0)
GAUSSIANS = 10_000
JUDGED = 4
"""Views on which the departure is measured."""

ADDED = {"frozen": "one added view", "free": "one added view, means free"}
"""By what the means may do: the name of a move."""

ACROSS = "mean across the view"
"""Moves of means without their part along the axis of the camera, for each view those of its
own."""


def _opacity(logit: np.ndarray, delta: np.ndarray) -> np.ndarray:
    opacity = expit(logit)
    low, high = np.minimum(opacity, LEAST), np.maximum(opacity, 1 - LEAST)
    return np.asarray(log_odds(np.clip(opacity + opacity * (1 - opacity) * delta, low, high)))


def _optical_depth(logit: np.ndarray, delta: np.ndarray) -> np.ndarray:
    depth = np.logaddexp(0, logit)  # -log(1 - opacity)
    return np.log(np.expm1(np.maximum(depth + expit(logit) * delta, LEAST)))


def _power(exponent: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """A power of the size s, of which the logarithm is given."""
    return lambda log_size, delta: (
        log_size + np.log(np.maximum(1 + exponent * delta, LEAST)) / exponent
    )


COORDINATES = {
    "opacity itself": ("logit_opacities", _opacity),
    "optical depth": ("logit_opacities", _optical_depth),
    "scale itself": ("log_scales", _power(1)),
    "scale squared": ("log_scales", _power(2)),
    "one over scale": ("log_scales", _power(-1)),
}
"""By name: the parameter, and f(value, delta) -> the parameter's new value when the other
coordinate moves by its derivative times delta; to first order that is value + delta."""

LEAST = 1e-3
"""Least value of a coordinate that must be positive, and of what is left of a size."""


def departure(
    model: Gaussians,
    move: dict[str, np.ndarray],
    cameras: Sequence[Camera],
    cache: ListCache,
    linear_move: dict[str, np.ndarray] | None = None,
) -> tuple[float, float]:
    """|h(theta + delta) - h(theta) - J delta| / |J delta| over the images of the cameras together;
    and the root mean square change |J delta| of a pixel value. linear_move: the delta of J delta,
    where it is not the move itself."""
    moved = replace(
        model, **{name: (getattr(model, name) + d).astype(np.float32) for name, d in move.items()}
    )
    # The change that was really made, after rounding.
    delta = linear_move or {name: getattr(moved, name) - getattr(model, name) for name in move}
    away, along, count = 0.0, 0.0, 0
    for camera in cameras:
        h0, h1 = (
            np.asarray(render(g, camera, cache=cache).rgb, np.float64) for g in (model, moved)
        )
        linear = np.asarray(jvp(model, delta, camera, cache=cache).rgb, np.float64)
        away, along, count = (
            away + ((h1 - h0 - linear) ** 2).sum(),
            along + (linear**2).sum(),
            count + linear.size,
        )
    return float(np.sqrt(away / along)), float(np.sqrt(along / count))


def across(moves: np.ndarray, camera: Camera) -> np.ndarray:
    """Moves of means [N,3] without their part along the axis of a camera, so that the order of
    depth stays."""
    axis = camera.world_to_camera[2, :3]
    return moves - (moves @ axis)[:, None] * axis


@dataclass(frozen=True)
class Rock:
    """A dataset, its prior, the views fitted to, those left, the cameras of those judged on, and
    where a fit starts."""

    dataset: Dataset
    prior: Prior
    taken: list[int]
    left: list[int]
    judged: list[Camera]
    start: Gaussians
    cache: ListCache

    def fitted(self, model: Gaussians, views: Sequence[int], passes: int, means: str) -> Gaussians:
        """The model fitted on to some views; means: the setting of that name."""
        train = TrainSettings(passes=passes, tolerance=0.0, means=means)  # type: ignore[arg-type]
        settings = NbvSettings(
            dataset=self.dataset.root, prior=self.dataset.root, train=train
        ).with_spacing(self.prior.spacing)
        frames, kinds = [self.dataset.frames[i] for i in views], groups(0, means)
        lam = lam_by_kind(settings.regularisation(kinds), kinds)
        cameras, targets = (
            [frame.camera for frame in frames],
            [target_of(frame) for frame in frames],
        )
        return fit(
            model, cameras, targets, settings.train, cache=self.cache, start=self.start, lam=lam
        ).gaussians

    def information(self, model: Gaussians, means: str) -> np.ndarray:
        """H of the views taken, [N,P]."""
        cameras = [self.dataset.frames[i].camera for i in self.taken]
        return np.sum(
            [fisher(model, c, cache=self.cache, means=means) for c in cameras],
            axis=0,
            dtype=np.float64,
        )


def rock_of(root: Path) -> Rock:
    """Four views spread evenly in azimuth, and the Gaussians that they start from."""
    dataset = load_dataset(root)
    prior, _ = build_prior(dataset, PriorSettings(gaussians=GAUSSIANS))
    cameras = [frame.camera for frame in dataset.frames]
    taken = seed_views(np.array([camera.position for camera in cameras]), prior.points.mean(0), 4)
    left = [i for i in range(len(cameras)) if i not in taken]
    judged = [cameras[i] for i in left[:: len(left) // JUDGED][:JUDGED]]
    start = initial_gaussians(prior, [dataset.frames[i] for i in taken])[0]
    return Rock(dataset, prior, taken, left, judged, start, ListCache())


def draws(rock: Rock, model: Gaussians) -> Iterator[dict[str, Any]]:
    """A record for each kind of draw and each factor."""
    lam, H = regularisation(groups(0)), rock.information(model, "frozen")
    draw = generator(0, "linearity").standard_normal(H.shape) * PIXEL_NOISE / np.sqrt(H + lam)
    columns = dict(zip(LEARNED, groups(0).values(), strict=True))
    whole = {name: draw[:, c].reshape(getattr(model, name).shape) for name, c in columns.items()}
    free = generator(0, "linearity/means").standard_normal((len(model), 3))
    of_means = rock.information(model, "free")[:, groups(0, "free")["mean"]]
    free *= PIXEL_NOISE / np.sqrt(of_means + (PIXEL_NOISE / (MEAN_STD * rock.prior.spacing)) ** 2)
    moves = {"all": whole, "mean": {"means": free}} | {
        kind: {name: whole[name]} for kind, name in zip(KINDS, LEARNED, strict=True)
    }
    for factor in FACTORS:
        for name, move in moves.items():
            ratio, size = departure(
                model, {k: factor * v for k, v in move.items()}, rock.judged, rock.cache
            )
            yield {"move": f"draw, {name}", "factor": factor, "departure": ratio, "rms": size}
        for coordinate, (name, values) in COORDINATES.items():
            delta = (factor * whole[name]).astype(np.float32)
            move = {
                name: values(getattr(model, name).astype(np.float64), delta) - getattr(model, name)
            }
            ratio, size = departure(model, move, rock.judged, rock.cache, {name: delta})
            yield {"move": f"draw, {coordinate}", "factor": factor, "departure": ratio, "rms": size}
        found = [
            departure(model, {"means": factor * across(free, c)}, [c], rock.cache)
            for c in rock.judged
        ]
        ratio, size = np.mean(found, axis=0)
        yield {"move": f"draw, {ACROSS}", "factor": factor, "departure": ratio, "rms": size}


def added_views(rock: Rock, model: Gaussians, passes: int, means: str) -> Iterator[dict[str, Any]]:
    """A record for each of three views that are added, one at a time, to those taken."""
    for added in rock.left[2::7][:3]:
        after = rock.fitted(model, [*rock.taken, added], passes, means)
        names = LEARNED if means == "frozen" else (*LEARNED, "means")
        ratio, size = departure(
            model,
            {name: getattr(after, name) - getattr(model, name) for name in names},
            rock.judged,
            rock.cache,
        )
        yield {"move": ADDED[means], "factor": 1.0, "departure": ratio, "rms": size}


def study(root: Path) -> list[dict[str, Any]]:
    """One record per model and move."""
    rock, records = rock_of(root), []
    for passes in PASSES:
        model, free = (rock.fitted(rock.start, rock.taken, passes, means) for means in ADDED)
        found = (
            draws(rock, model),
            added_views(rock, model, passes, "frozen"),
            added_views(rock, free, passes, "free"),
        )
        for record in chain(*found):
            records.append({"passes": passes} | record)
            print(records[-1], flush=True)
    return records


def draw(path: Path, records: list[dict[str, Any]]) -> None:
    """Departure against the size of the move, by kind of parameter."""
    import matplotlib

    colours = dict(
        zip(
            ("all", *KINDS, "mean", ACROSS),
            ("#000000", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"),
            strict=True,
        )
    )
    with matplotlib.rc_context(STYLE):
        figure = new_figure(7.2, 3.4)
        for axis, passes in zip(figure.subplots(1, 2, sharey=True), PASSES, strict=True):
            for kind, colour in colours.items():
                rows = [r for r in records if (r["passes"], r["move"]) == (passes, f"draw, {kind}")]
                axis.plot(
                    [r["factor"] for r in rows],
                    [r["departure"] for r in rows],
                    "o-",
                    color=colour,
                    label=kind,
                )
            for move, marker in zip(ADDED.values(), ("x", "+"), strict=True):
                real = [
                    r["departure"] for r in records if (r["passes"], r["move"]) == (passes, move)
                ]
                axis.plot(
                    [1.0] * len(real), real, marker, linestyle="", color="#000000", label=move
                )
            axis.set(
                xscale="log",
                yscale="log",
                ylim=(0.2, 12),
                xlabel="size of the draw (posterior standard deviations)",
            )
            axis.set_title(f"after {passes} passes")
            axis.axhline(1, color="#888888", linewidth=0.8)
        figure.axes[0].set(ylabel="departure from linear")
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(
            handles,
            labels,
            ncols=5,
            loc="outside upper center",
            columnspacing=0.8,
            handlelength=1.2,
        )
        save_figure(figure, path)


def main(prefix: Path, *datasets: str) -> None:
    """Measure, write, draw."""
    runtime.start()
    scenes = {}
    for name, _, root in (entry.partition("=") for entry in datasets):
        print(name, flush=True)
        scenes[name] = study(Path(root))
    made = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    write_json(prefix.with_suffix(".json"), made | {"scenes": scenes})
    draw(prefix.with_suffix(".png"), next(iter(scenes.values())))


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
