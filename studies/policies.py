"""Policies kept for comparison alone, as a user's own: `--policy studies/policies.py:NAME`."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

import mgs
from mgs.colour import SH_C0, sh_basis
from mgs.data.frames import in_image
from mgs.evaluation import psnr_measure
from mgs.gaussians import sh_from_rgb
from mgs.learning import fit_views
from mgs.policy import criteria
from mgs.policy.criteria import Array
from mgs.policy.poses import angles
from mgs.run.policies import Cover, Directional, Information, Paper, each
from mgs.splat import fisher, groups, render

LAMBDA = 1e-6
"""Lambda of FisherRF's code for every parameter. POp-GS states none."""

BINS = 128
"""Directions of the sphere that nbv_gym counts views in."""

PROBES, STEPS = 4, 8
"""Random vectors of `full_d`, and steps of the Lanczos iteration of each: an error of 1 % or 2."""

UNSEEN_VARIANCE = 1 / 12
"""Variance of a colour of which nothing is known: uniform from 0 to 1."""

BLOCKS_AT_ONCE = 2048
"""Blocks whose determinants are computed together: 2 MB, which fit into a core's cache."""


def block_d(scene: mgs.Scene, state: mgs.State, views: list[int]) -> np.ndarray:
    """Eq. 7 for the exact 11x11 blocks (14x14 with free means), whatever the estimator [C]."""
    return _block_d(scene, state, views, scene.lam)


def _block_d(scene: mgs.Scene, state: mgs.State, views: list[int], lam: Array) -> np.ndarray:
    """`block_d` with another lambda [P]."""

    def F(view: int) -> Array:
        return scene.information(state, view, "block")

    first, *others = state.taken
    H = np.array(F(first), np.float64)
    for view in others:
        H += F(view)
    before = block_log_determinant(H, lam)
    return each(views, lambda i: block_log_determinant(H + F(i), lam)) - before


def block_log_determinant(H: Array, lam: Array) -> float:
    """1/l sum over the Gaussians of log det(I + Lambda^-1/2 H Lambda^-1/2), Lambda = diag(lam).

    H: blocks of J^T J [N,P,P], which hold the correlations between the parameters of one Gaussian.
    The difference of two such values is Eq. 7 for blocks. If rounding has made an eigenvalue -1 or
    less, negative eigenvalues of its group of BLOCKS_AT_ONCE blocks count as 0.
    """
    whitening, total = 1 / np.sqrt(np.multiply.outer(lam, lam)), 0.0
    for first in range(0, len(H), BLOCKS_AT_ONCE):
        whitened = H[first : first + BLOCKS_AT_ONCE] * whitening
        try:
            factor = np.linalg.cholesky(whitened + np.eye(len(lam)))
            total += 2 * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum()
        except np.linalg.LinAlgError:
            total += np.log1p(np.maximum(np.linalg.eigvalsh(whitened), 0)).sum()
    return float(total / (len(H) * len(lam)))


def full_d(scene: mgs.Scene, state: mgs.State, views: list[int]) -> np.ndarray:
    """Eq. 7 for the whole J^T J, with all correlations between Gaussians that share a pixel [C]. An
    estimate (`mgs.Information.log_det`), with the same random vectors for all views."""
    cameras, means = state.cameras, scene.settings.train.means

    def log_det(some: tuple[int, ...]) -> float:
        seen = [cameras[i] for i in some]
        H = mgs.Information(state.gaussians, seen, means=means, cache=scene.cache)
        return H.log_det(scene.lam, PROBES, STEPS).value

    before = log_det(state.taken)
    return (each(views, lambda i: log_det((*state.taken, i))) - before) / state.H.size


def angle(candidates: Array, taken: Array, centre: Array) -> Array:
    """Angle at `centre` to the nearest camera already taken, radians [C]."""
    return np.round(angles(candidates, taken, centre).min(axis=1), 9)


def near_angle(candidates: Array, taken: Array, centre: Array) -> Array:
    """`angle` among the nearest third of all poses; among the others once these are taken [C]."""
    distance = np.linalg.norm(np.concatenate([candidates, taken]) - centre, axis=1)
    near = distance[: len(candidates)] <= np.quantile(distance, 1 / 3) * (1 + 1e-6)
    return angle(candidates, taken, centre) + 2 * np.pi * near


def _exchanged(views: Sequence[int], count: int, cost: Callable[[list[int]], Array]) -> list[int]:
    """Plan of at most `count` of `views`: one view at a time is exchanged until nothing changes.

    cost(others): value to be minimised, of the plan of these others and each of `views` [C]."""
    plan: list[int] = []
    before = None
    while plan != before:
        before = list(plan)
        for k in range(min(count, len(views))):
            others = plan[:k] + plan[k + 1 :]
            costs = np.round(cost(others), 9)
            costs[[views.index(view) for view in others]] = np.inf
            plan[k : k + 1] = [views[int(np.argmin(costs))]]
    return plan


class Medoids:
    """Views whose directions represent those of all poses, planned together.

    k-medoids: the sum over the pool of the squared angle to the nearest view is lowered by
    exchanges. Scores are those of `angle`.
    """

    name, needs_fit, geometric = "medoids", False, True

    def __call__(self, scene: mgs.Scene, state: mgs.State, views: list[int]) -> np.ndarray:
        positions = scene.positions(state.frames)
        return angle(positions[views], positions[list(state.taken)], scene.centre)

    def plan(
        self, scene: mgs.Scene, state: mgs.State, views: list[int], count: int, nearest: int | None
    ) -> list[int]:
        """k-medoids after the views taken; all views if each must be near the one before."""
        if nearest is not None:
            return views
        positions = scene.positions(state.frames)
        squared = angles(positions, positions, scene.centre) ** 2
        first = squared[list(state.taken)].min(axis=0)

        def cost(others: list[int]) -> Array:
            nearest_other = np.minimum(first, squared[others].min(axis=0, initial=np.inf))
            return np.asarray(np.minimum(nearest_other, squared[views]).sum(axis=1))

        return _exchanged(views, count, cost)


medoids = Medoids()


class CoverPlan(Cover):
    """COVER with its views planned together: after them the whole pool shows least that is new.

    The sum of COVER's scores over all poses is lowered by exchanges. Scores are COVER's."""

    name = "cover-plan"

    def plan(
        self, scene: mgs.Scene, state: mgs.State, views: list[int], count: int, nearest: int | None
    ) -> list[int]:
        """Plan after the views taken; all views if each must be near the one before."""
        if nearest is not None:
            return views
        key = "cover-plan", state.taken[: state.seeds], state.moved
        novelty, weights = scene.once(key, lambda: _novelty(scene, state))
        first = novelty[list(state.taken)].min(axis=0)

        def cost(others: list[int]) -> Array:
            left = np.minimum(first, novelty[others].min(axis=0, initial=1))
            return np.array([(np.minimum(left, novelty[view]) * weights).sum() for view in views])

        return _exchanged(views, count, cost)


def _novelty(scene: mgs.Scene, state: mgs.State) -> tuple[Array, Array]:
    """COVER's (1 - cos)/2 of each Gaussian in each pose, if another pose alone was taken; 1 where
    that does not observe it [taken V, pose V, N]. Weights of the Gaussians in each pose [V,N]."""
    surface, least = scene.surface(state), scene.surface_lam[0] / SH_C0**2
    seen = np.stack([surface.seen(i) for i in range(len(state.frames))])
    offset = surface.points - surface.positions[:, None]
    towards = (offset / np.linalg.norm(offset, axis=2, keepdims=True)).astype(np.float32)
    apart = np.stack([(1 - (towards * one).sum(axis=2)) / 2 for one in towards])
    apart = np.where((seen > least)[:, None], apart, np.float32(1))
    return apart, seen / seen.sum(axis=1, keepdims=True).clip(1e-12)


cover_plan = CoverPlan()


class Greedy:
    """`directional-i` without its plan: the view of largest gain at each step."""

    name, needs_fit = "greedy", False

    def __call__(self, scene: mgs.Scene, state: mgs.State, views: list[int]) -> np.ndarray:
        return Directional()(scene, state, views)


greedy = Greedy()


# --- Published policies, as near as we get: see docs/results.md, The published protocol -----------


def _with_lambda(name: str, criterion: criteria.Score) -> Information:
    """Policy of a criterion with LAMBDA for all parameters, whatever the scene's lambda."""
    return Information(name, lambda F, H, lam: criterion(F, H, np.full_like(lam, LAMBDA)))


fisherrf_paper = _with_lambda("fisherrf (paper)", criteria.fisherrf)
popgs_t = _with_lambda("popgs-t", criteria.a_optimal)
popgs_d = _with_lambda("popgs-d", criteria.d_optimal)


def popgs_block(scene: mgs.Scene, state: mgs.State, views: list[int]) -> np.ndarray:
    """POp-GS's D-optimality of blocks, with LAMBDA [C]."""
    return _block_d(scene, state, views, np.full_like(scene.lam, LAMBDA))


def fisherrf_code(scene: mgs.Scene, state: mgs.State, views: list[int]) -> np.ndarray:
    """FisherRF as its code computes it: sum F / (H + LAMBDA) [C], in front of white.

    Its CUDA kernel squares the gradient of each pixel by colours, scales, opacity and means, after
    it has summed the channels (for colours each alone). PyTorch then multiplies by the derivative
    of scale and opacity by their stored values once, not twice. Quaternions are left out.
    """
    model, of = state.gaussians, groups(0, "free")
    mean = model.sh[:, :1].mean(axis=2, keepdims=True)
    grey = replace(model, sh=np.repeat(mean, 3, axis=2))
    opacity = 1 / (1 + np.exp(-model.logit_opacities))
    slope = np.ones((len(model), of["mean"].stop))
    slope[:, of["scale"]] = np.exp(model.log_scales)
    slope[:, of["opacity"]] = (opacity * (1 - opacity))[:, None]
    factor = 3 / slope  # three equal channels: (3 g)^2 = 3 (3 g^2)
    factor[:, of["colour"]], factor[:, of["rotation"]] = 1, 0

    def F(view: int) -> Array:
        camera = state.frames[view].camera
        return factor * fisher(grey, camera, background=1.0, cache=scene.cache, means="free")

    weight = 1 / (sum(map(F, state.taken)) + LAMBDA)
    return each(views, lambda i: float((F(i) * weight).sum()))


def paper_still(scene: mgs.Scene, state: mgs.State, views: list[int]) -> np.ndarray:
    """The policy `paper` without information about means, where they are free [C]."""
    train = scene.settings.train.model_copy(update={"means": "frozen"})
    settings = scene.settings.model_copy(update={"train": train})
    return Paper()(scene.once("still", lambda: replace(scene, settings=settings)), state, views)


def _drawn(scene: mgs.Scene, model: mgs.Gaussians, view: mgs.Camera, values: Array) -> np.ndarray:
    """Sums over the Gaussians of w values, and of w, in each pixel [2,H,W]. values: [N], 0 to 1."""
    grey = sh_from_rgb(np.repeat(values[:, None], 3, axis=1))
    image = render(replace(model, sh=grey), view, cache=scene.cache)
    return np.stack([np.asarray(image.rgb)[..., 0], np.asarray(image.alpha)])


def _towards(model: mgs.Gaussians, camera: mgs.Camera) -> np.ndarray:
    """Unit vectors from the camera to the means [N,3]."""
    offset = model.means - camera.position
    return np.asarray(offset / np.linalg.norm(offset, axis=1, keepdims=True))


def cover_gym(scene: mgs.Scene, state: mgs.State, views: list[int]) -> np.ndarray:
    """COVER as nbv_gym computes it [C]: blending weights to the first power, BINS directions, every
    Gaussian in the frustum counted as seen, hidden or not, and the mean over pixels that show
    something. Its radius clip of 3 pixels is left out."""
    model, i = state.gaussians, np.arange(BINS)
    z, turn = 1 - (2 * i + 1) / BINS, np.pi * (np.sqrt(5) - 1) * i
    flat = np.sqrt(1 - z**2)
    bins = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], 1)
    met = np.zeros((len(model), BINS), bool)
    for camera in (state.frames[k].camera for k in state.taken):
        seen = np.flatnonzero(in_image(camera, *camera.project(model.means)))
        met[seen, (_towards(model, camera)[seen] @ bins.T).argmax(1)] = True

    def novelty(view: int) -> float:
        camera = state.frames[view].camera
        covered = np.where(met, (1 + _towards(model, camera) @ bins.T) / 2, 0).max(1)
        drawn, alpha = _drawn(scene, model, camera, covered)
        return -float(drawn.sum() / max((alpha > 0).sum(), 1))

    return each(views, novelty)


def gavis_like(scene: mgs.Scene, state: mgs.State, views: list[int]) -> np.ndarray:
    """Expected information of a view by an anisotropic visibility field, after GAVIS (2026) [C].

    The field of each Gaussian is the sum over the views that observe it of a spherical-harmonic
    kernel (degree 3, 1 at its centre), clipped to [0, 1]. A pixel's variance is that of its noise,
    and UNSEEN_VARIANCE times the sum of w (1 - field). The gain is the sum over pixels of
    1/2 log(variance / noise). GAVIS's Bayesian network and its planner are not reproduced.
    """
    model, least = state.gaussians, scene.lam[0] / SH_C0**2
    field = np.zeros((len(model), 16))
    for k in state.taken:
        camera = state.frames[k].camera
        observing = scene.information(state, k)[:, :3].max(axis=1) / SH_C0**2 > least
        field += observing[:, None] * sh_basis(_towards(model, camera), 3) * (4 * np.pi / 16)

    def gain(view: int) -> float:
        camera = state.frames[view].camera
        visible = (field * sh_basis(_towards(model, camera), 3)).sum(1).clip(0, 1)
        unseen, _ = _drawn(scene, model, camera, 1 - visible)
        ratio = UNSEEN_VARIANCE / scene.settings.pixel_noise**2
        return float(0.5 * np.log1p(ratio * unseen.clip(0)).sum())

    return each(views, gain)


# --- Upper bound ----------------------------------------------------------------------------------


class Oracle:
    """Sees the truth: fits to every candidate, and scores it by mean PSNR over the test views, dB.

    It reads the images of all candidates, so it is no policy. It is greedy, so better choices may
    exist."""

    name, needs_fit = "oracle", True

    def __init__(self, tests: mgs.Dataset) -> None:
        self.measure = psnr_measure(tests, mgs.ListCache())

    def __call__(self, scene: mgs.Scene, state: mgs.State, views: list[int]) -> np.ndarray:
        fits = (fit_views(scene, state.frames, (*state.taken, view), state)[0] for view in views)
        return np.array([self.measure(fit.gaussians, [])["psnr"] for fit in fits])
