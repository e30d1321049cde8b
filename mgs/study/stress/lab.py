"""What the experiments work on: small rocks, each made once, and the calls that most experiments
need."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mgs.camera import Camera
from mgs.data.dataset import Frame, load_dataset, target_of
from mgs.fit.fitting import Fit, fit
from mgs.fit.settings import MEAN_RATE, PASSES, RATES, WARM_PASSES, TrainSettings
from mgs.gaussians import Gaussians
from mgs.policy.context import PolicyContext
from mgs.policy.criteria import MEAN_STD, PRIOR_STD, Score, d_optimal, lam_by_kind, regularisation
from mgs.policy.poses import seed_views
from mgs.policy.registry import policy_named
from mgs.policy.visibility import Visibility
from mgs.prior.build import Prior, load_prior
from mgs.prior.initial import initial_gaussians, initial_normals, warm_start
from mgs.run.operations import psnr_measure
from mgs.seeds import generator
from mgs.splat import ListCache, fisher, groups
from mgs.study.material import made_dataset, made_prior, test_views_of
from mgs.study.sweep import Cell, cell_folder
from mgs.synth.rendering import RenderPreset as Images
from mgs.synth.scene_file import load_scene_file

Array = NDArray[np.floating]

CACHE = 1 << 28
"""Budget of the block lists of one lab, bytes."""


POLICIES = ("d-optimal", "directional-i", "uniform", "random")
"""Whose order is compared, where data or light are bad."""


@dataclass(frozen=True)
class Preset:
    """How large the experiments are.

    images: of every dataset. tests: test views of each. gaussians: of each prior. rocks: the
    (scene, seed) that all experiments
    use. others: more of them, for the experiment on scenes. turns: sets of views per rock, turned
    against one another, so that
    there are several runs per rock. repeats: draws of each random fault. few_views: numbers of
    views with free means; 2
    and 4 are among them. passes: lengths of fits. steps: of the test of memory.
    """

    images: Images
    tests: int
    gaussians: int
    rocks: tuple[tuple[str, int], ...]
    others: tuple[tuple[str, int], ...]
    turns: int
    repeats: int
    few_views: tuple[int, ...]
    passes: tuple[int, ...]
    steps: int


PRESETS = {
    "quick": Preset(
        Images(160, 120, 24, 8), 8, 3000, (("boulder", 0), ("boulder", 1)), (("contact-binary", 0), ("low-sun", 0)),
        2, 1, (2, 4, 8), (1, 2, 5, 10, 20, 60, 120), 150,
    ),
    "full": Preset(
        Images(320, 240, 32, 8), 12, 10_000, (*(("boulder", seed) for seed in range(5)), ("strata", 0), ("strata", 1)),
        tuple((name, seed) for name in ("contact-binary", "low-sun", "pebbles") for seed in range(3)),
        3, 3, (2, 3, 4, 6, 8), (1, 2, 5, 10, 20, 40, 80, 160, 320, 640), 1000,
    ),
}  # fmt: skip


def scene_cell(preset: Preset, scene: str, seed: int) -> Cell:
    """The cell that makes a dataset and its prior."""
    images = preset.images
    arguments = {
        "scene": scene, "seed": seed, "width": images.width, "height": images.height, "frames": images.frames,
        "spp": images.spp, "tests": preset.tests, "gaussians": preset.gaussians,
    }  # fmt: skip
    return Cell(f"dataset/{scene}-{seed}", f"{__name__}:make_scene", arguments)


def variant_cell(
    preset: Preset,
    scene: str,
    seed: int,
    variant: str,
    changes: dict[str, dict[str, Any]],
    **other: int,
) -> Cell:
    """The same for a scene of which some keys have other values; its name ends in that of the
    variant.

    changes: the values by section and key of the scene file. other: arguments of `make_scene` in
    place of the preset's.
    """
    cell = scene_cell(preset, scene, seed)
    return replace(
        cell, name=f"{cell.name}-{variant}", arguments=cell.arguments | {"changes": changes} | other
    )


def make_scene(
    root: Path,
    out: Path,
    scene: str,
    seed: int,
    width: int,
    height: int,
    frames: int,
    spp: int,
    tests: int,
    gaussians: int,
    changes: dict[str, dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """Render a dataset into OUT/dataset and build its prior, unless it has 0 Gaussians, in
    OUT/prior. changes: as in `variant_cell`."""
    loaded = load_scene_file(scene)
    sections = {
        name: getattr(loaded, name).model_copy(update=values)
        for name, values in (changes or {}).items()
    }
    images = Images(width, height, frames, spp)
    made_dataset(out / "dataset", loaded.model_copy(update=sections), images, seed, tests)
    if gaussians:
        made_prior(out / "prior", out / "dataset", gaussians=gaussians, seed=seed)
    return {"gaussians": gaussians}


@dataclass(frozen=True)
class Lab:
    """A rock to experiment on: frames to fit to, a prior, and a measure on test views, which no
    fault ever touches."""

    name: str
    frames: tuple[Frame, ...]
    prior: Prior
    measure: Callable[[Gaussians, list[int]], dict[str, float]]
    cache: ListCache = field(default_factory=lambda: ListCache(CACHE))

    @property
    def cameras(self) -> list[Camera]:
        """Of all frames."""
        return [frame.camera for frame in self.frames]

    def changed(self, **fields: Any) -> Lab:
        """The same with other frames or another prior, and a cache of its own."""
        return replace(self, cache=ListCache(CACHE), **fields)

    def even(self, count: int, turn: float = 0.0) -> list[int]:
        """Views at evenly spaced azimuths; turn: from 0 to 1, by which share of the spacing they
        are turned."""
        angle = -2 * np.pi * turn / count
        about_z = np.array(
            [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        )
        centre = self.prior.points.mean(0)
        positions = np.array([camera.position for camera in self.cameras])
        return seed_views((positions - centre) @ about_z.T, np.zeros(3), count)

    def left(self, taken: Sequence[int]) -> list[int]:
        """Frames that were not taken."""
        return [i for i in range(len(self.frames)) if i not in taken]

    def start(self, taken: Sequence[int]) -> Gaussians:
        """The Gaussians before training, coloured by the views taken."""
        return initial_gaussians(self.prior, [self.frames[i] for i in taken])[0]

    def lam(self, means: str = "frozen") -> Array:
        """lambda of each column of the information, for the default settings of `mgs nbv`."""
        return regularisation(
            groups(0, means), prior_std=PRIOR_STD | {"mean": MEAN_STD * self.prior.spacing}
        )

    def fit(
        self,
        taken: Sequence[int],
        passes: int = PASSES,
        means: str = "frozen",
        with_prior: bool = True,
        model: Gaussians | None = None,
        start: Gaussians | None = None,
        seed: int = 0,
    ) -> Fit:
        """A fit of exactly so many passes, otherwise with the default settings of `mgs nbv`.
        with_prior: whether lambda holds
        the parameters. model: where it begins; start: where lambda holds the parameters; both by
        default the Gaussians before
        training. seed: of the order of the images."""
        start = self.start(taken) if start is None else start
        rates = RATES | {"mean": MEAN_RATE * self.prior.spacing}
        settings = TrainSettings(passes=passes, tolerance=0.0, means=means, rates=rates, seed=seed)  # type: ignore[arg-type]
        lam = lam_by_kind(self.lam(means), groups(0, means)) if with_prior else None
        frames = [self.frames[i] for i in taken]
        return fit(
            start if model is None else model, [frame.camera for frame in frames], [target_of(frame) for frame in frames],
            settings, None, self.cache, start, lam, initial_normals(self.prior),
        )  # fmt: skip

    def information(
        self, model: Gaussians, views: Sequence[int], means: str = "frozen"
    ) -> list[Array]:
        """Exact Fisher information [N,P] of some of the views."""
        return [
            fisher(model, self.cameras[i], cache=self.cache, means=means).astype(np.float64)
            for i in views
        ]

    def scores(
        self,
        model: Gaussians,
        taken: Sequence[int],
        left: Sequence[int],
        score: Score = d_optimal,
        means: str = "frozen",
    ) -> Array:
        """What a criterion gives to each of the views left."""
        H = np.sum(self.information(model, taken, means), axis=0)
        lam = self.lam(means)
        return np.array([score(F, H, lam) for F in self.information(model, left, means)])

    def quality(self, model: Gaussians) -> dict[str, float]:
        """PSNR on the test views, dB: mean over whole images (`psnr`), and inside the rock's mask
        (`psnr_mask`)."""
        found = self.measure(model, [])
        return {"psnr": found["psnr"], "psnr_mask": found["psnr_mask"]}


@functools.lru_cache(maxsize=2)
def _opened(folder: Path, name: str) -> Lab:
    dataset = load_dataset(folder / "dataset")
    measure = psnr_measure(test_views_of(dataset), ListCache(CACHE))
    return Lab(name, dataset.frames, load_prior(folder / "prior"), measure)


def open_lab(root: Path, scene: str) -> Lab:
    """The rock that the cell `dataset/SCENE` made; scene: name and seed, as in boulder-0."""
    return _opened(cell_folder(root, f"dataset/{scene}"), scene)


def greedy(
    lab: Lab, taken: Sequence[int], allowed: Sequence[int], count: int, policy: str = "d-optimal"
) -> list[int]:
    """Views after `count` steps of the loop, fitted as `mgs nbv` does by default, candidates only
    among `allowed`.

    policy: "d-optimal", or one of `mgs.policy.registry.policy_names` that looks at poses and the
    prior's surface alone.
    """
    views, start = list(taken), lab.start(taken)
    model, of_surface = (
        start,
        None if policy == "d-optimal" else _surface_scores(lab, start, policy),
    )
    for step in range(count):
        left = [i for i in allowed if i not in views]
        if of_surface is None:
            before, start = start, lab.start(views)
            passes = PASSES if step == 0 else WARM_PASSES
            model = lab.fit(
                views, passes, model=warm_start(model, before, start), start=start
            ).gaussians
            scores = lab.scores(model, views, left)
        else:
            scores = of_surface(views, left, generator(0, f"stress/{policy}/{step}"))
        views.append(left[int(np.argmax(scores))])
    return views


def by_policy(
    lab: Lab, seeds: Sequence[int], count: int, policies: Sequence[str] = POLICIES
) -> list[dict[str, Any]]:
    """Quality of a model of `count` views, of which all but the seeds were chosen by a policy: a
    row for each policy."""
    rows = []
    for policy in policies:
        views = greedy(lab, seeds, range(len(lab.frames)), count - len(seeds), policy)
        rows.append({"policy": policy, **lab.quality(lab.fit(views).gaussians)})
    return rows


def _surface_scores(
    lab: Lab, start: Gaussians, policy: str
) -> Callable[[list[int], list[int], np.random.Generator], NDArray[np.float64]]:
    """A function of the views taken, those left and a generator, that gives each of those left the
    score of a policy.

    start: the Gaussians before training, in any colours."""
    choose, lam, n = policy_named(policy), lab.lam(), len(lab.prior.points)
    points, centre = start.means[:n], lab.prior.points.mean(0)

    def look(camera: Camera) -> Array:
        return fisher(start, camera, cache=lab.cache)[:n]

    sight = Visibility(lab.cameras, look, points, centre, float(lam[0]))
    unknown, nothing = np.zeros((0, len(lam))), _of_fit

    def scores(views: list[int], left: list[int], rng: np.random.Generator) -> NDArray[np.float64]:
        return np.asarray(choose(PolicyContext(
            positions=sight.positions, candidate_frames=left, taken_frames=views, centre=centre, rng=rng, H=unknown, lam=lam, points=points,
            surface_H=unknown, prior_lam=lam, information=nothing, surface_information=nothing, estimate=nothing,
            seen=sight.seen, dome=sight.dome, gains=sight.gains,
        )))  # fmt: skip

    return scores


def _of_fit(*_: object) -> Array:
    raise NotImplementedError(
        "greedy: has no information for this policy; it serves d-optimal, and what needs no fit"
    )
