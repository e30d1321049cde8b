"""A run's model in so many bytes, or with so much quality: `mgs export RUN --bytes`, `--psnr`."""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from mgs.colour import srgb_from_linear
from mgs.compact.columns import SHAPE, Start, start_of
from mgs.compact.container import Header
from mgs.compact.encode import Compact, Encoder, Plan
from mgs.errors import InputError
from mgs.evaluation import psnr_over
from mgs.gaussians import KINDS, Gaussians
from mgs.policy.criteria import PRUNE_NOISE
from mgs.progress import report
from mgs.reports.exporting import as_imported, in_srgb, to_y_up
from mgs.run.folder import Run
from mgs.scene import Scene
from mgs.seeds import generator
from mgs.splat_files import FORMATS, load_gaussians, write_gaussians
from mgs.splat_places import from_source

SCALES = (1e-3, 1.0)  # of steps: rms error of an image, (pixel value) per coefficient
HALVINGS = 9  # halvings of that range, in its logarithm: steps are found to 1.4 %
VIEWS = 16  # most views, evenly spread over those taken, in which errors are weighed
STEP = 1e-4  # linear RGB, by which the slope of sRGB is measured
CLOSE = 50  # searches for a PSNR end at numbers of Gaussians that differ by 1/CLOSE
THINNINGS = 4  # times that half of the Gaussians are removed
AGAIN = 0.3  # learning rates of a further fit over those of a first one, which leave its optimum
ROUNDS = 2  # most further fits of what the best file gives, while it is worse than the run's model
HOLDS = 5  # passes of `settled` in which ever more coefficients are held
GENTLE = 0.1  # learning rates there over those of a first fit: what is left is as small as a step
FALL = 0.1  # factor by which they fall in these passes
SPARE = 0.9  # share of the bytes, or dB, that a settled file spares, which the next one spends


@dataclass(frozen=True)
class Compacted:
    """A file and its number of Gaussians. psnr: mean of the views taken, dB, of the run's model and
    of this one."""

    data: bytes
    count: int
    psnr: tuple[float, float]


def compact_run(
    run: Run, size: int | None = None, psnr: float | None = None, shared: bool = False
) -> Compacted:
    """Make the best model of at most `size` bytes, or the smallest of `psnr` dB in the views taken.

    shared: the receiver has the run's prior, which gives positions. Raises InputError if
    neither can be reached, for a shared prior whose Gaussians were moved or changed by the fit, and
    as `Run.state`."""
    measured, encoder = _measure(run), encoding(run, shared)
    before = measured(run.gaussians)
    _check_reachable(str(run.folder), psnr, before)
    aim = float((size if psnr is None else psnr) or 0)
    enough = None if psnr is None else lambda model: measured(model) >= aim

    def worth(file: Compact) -> float:
        return measured(file.model) if size else -len(file)

    def steps(encoder: Encoder) -> Compact | None:
        report("choosing steps")
        return _fitted(encoder, int(aim) if size else None, enough)

    best: _Coded | None = None
    for some, kept in thinned(run, whole=shared):
        if file := steps(encoder(some, kept)):
            one = _Coded(worth(file), file, kept)
            best = max(best or one, one, key=lambda coded: coded.worth)
            if size and file.header.scale < 1.02 * SCALES[0]:  # all fits at the finest steps
                break
    if best is None:
        least = "it takes more bytes to place its Gaussians" if size else "no steps are fine enough"
        raise InputError(f"{run.folder}: {least}; ask for more bytes or a lower psnr")
    fit = refitting(run) if run.settings.prior.is_dir() else None
    for _ in range(ROUNDS):
        lost = measured(best.file.model) < before  # what is better already would overfit
        if fit is None or not lost or len(best.file.model) < len(best.kept):
            break  # or one Gaussian stands for several
        report("fitting what the file gives")
        again = encoder(fit(best.file.model), best.kept, best.file.header)
        if (plain := steps(again)) is None:
            break
        other, kept = settled(again.plan(plain.header.scale), fit), best.kept
        for file in (plain, other):  # the latter is larger where steps are much finer than the fit
            spare = (size or 0) - len(file) if psnr is None else psnr - measured(file.model)
            file = file.first(size) if size else file
            if file.payloads if size else spare <= 0:
                best = max(best, _Coded(worth(file), file, kept), key=lambda coded: coded.worth)
        aim += SPARE * max(spare, 0.0) if size else SPARE * min(spare, 0.0)
    return Compacted(bytes(best.file), len(best.file.model), (before, measured(best.file.model)))


class _Coded(NamedTuple):
    """A file, the indices of its Gaussians in the run's, and what it is worth: PSNR in dB, or how
    few bytes it has."""

    worth: float
    file: Compact
    kept: np.ndarray


def _measure(run: Run) -> Callable[[Gaussians], float]:
    """A function model -> mean PSNR of the views taken, dB."""
    from mgs.splat import ListCache

    exposure, views = run.settings.exposure, range(len(run.taken))
    quality = psnr_over(run.taken, ListCache(), exposure, run.dataset.world)
    key = "psnr_corrected" if exposure else "psnr"
    return lambda model: float(np.nanmean(quality(model, views)[key]))


def _check_reachable(model: str, psnr: float | None, most: float) -> None:
    if psnr is not None and not psnr < most:
        own = f"{model} has {most:.2f} dB in the views taken"
        raise InputError(f"psnr {psnr:g}: {own}; ask for less")


def refitting(run: Run) -> Callable[..., Gaussians]:
    """A function fit(g, rate, learn, passes) that fits Gaussians to the views taken once more, with
    themselves as the prior. rate: learning rates over those of a first fit. learn: kinds of
    parameters that change. passes: most passes; None: as in a first fit."""
    from mgs.fit.fitting import fit_gaussians

    scene, frames = Scene(run.dataset, run.prior, run.settings), run.taken
    gains = scene.measured_exposure(frames) if run.settings.exposure else None
    targets, lam = scene.targets(frames, gains), run.settings.lam_by_kind(scene.groups)
    cameras, train = [frame.camera for frame in frames], run.settings.train

    def fit(
        g: Gaussians,
        rate: float = AGAIN,
        learn: Collection[str] = tuple(train.rates),
        passes: int | None = None,
    ) -> Gaussians:
        rates = {kind: rate * (kind in learn) * first for kind, first in train.rates.items()}
        changes = {"density": "fixed", "rates": rates, "passes": passes or train.passes}
        further = train.model_copy(update=changes)
        return fit_gaussians(g, cameras, targets, further, cache=scene.cache, lam=lam).gaussians

    return fit


def settled(plan: Plan, fit: Callable[..., Gaussians]) -> Compact:
    """File whose coefficients make up for each other's rounding. fit: of `refitting`.

    Zeros, then more of the others in each pass, are held at whole steps, while the rest is fitted.
    At last colours and opacities are fitted to the shapes of the file."""
    values = plan.values
    turn = generator(0, "settled").random(values.shape)  # in which they are held, 0 to 1
    turn[plan.whole(values) == 0] = 0
    held = np.zeros(values.shape, bool)
    for done in range(HOLDS):
        new = (turn <= done / HOLDS) & ~held
        values, held = np.where(new, plan.whole(values), values), held | new
        rate = GENTLE * FALL ** (done / (HOLDS - 1))
        free = plan.values_of(fit(plan.model(values), rate, KINDS, 1))
        values = np.where(held, values, free)
    values = plan.whole(values)
    free = plan.values_of(fit(plan.model(values), GENTLE, ("colour", "opacity")))
    free[:, SHAPE] = values[:, SHAPE]
    return plan.file(free)


def thin_run(run: Run, kind: str, size: int | None = None, psnr: float | None = None) -> Compacted:
    """Make a file of another format (`mgs.splat_files.FORMATS`) with as many Gaussians as fit into
    `size` bytes, or as few as have `psnr` dB in the views taken.

    All Gaussians of such a file take the same bytes, so those go that change the views taken least,
    at most half at a time. The rest is fitted to these once more. Raises InputError if neither can
    be reached, and as `Run.state`."""
    from mgs.fit.pruning import fewest

    world, cameras = run.dataset.world, [frame.camera for frame in run.taken]
    measured, again = _measure(run), refitting(run)

    def fitted(count: int) -> tuple[Gaussians, bytes]:
        """The Gaussians to go on from, fitted only if half are gone, as more fits than that match
        the views taken alone; and the file of the fitted ones."""
        report(f"fitting {count:,} Gaussians")
        some = rest[fewest(rest, cameras, count)]
        fit = again(some)
        return fit if 2 * count <= len(rest) else some, written(fit)

    def written(model: Gaussians) -> bytes:
        write_gaussians(path, as_imported(run, model), kind, to_y_up(world.up))
        return path.read_bytes()

    def quality() -> float:
        """PSNR of the file that was written last."""
        return measured(from_source(load_gaussians(path), world))

    with TemporaryDirectory() as folder:
        path, rest = Path(folder) / f"x{FORMATS[kind]}", in_srgb(run.gaussians[run.shown])
        header = len(written(rest[:1]))  # with one Gaussian
        few = f"one Gaussian takes {header:,} bytes; ask for more bytes"
        if size is not None and size < header:
            raise InputError(f"{run.folder} as {kind}: {few}")
        data, before = written(rest), measured(run.gaussians)
        if run.gaussians.linear:  # its colours change as they are blended in another space
            data = fitted(len(rest))[1]
        _check_reachable(f"{run.folder} as {kind}", psnr, quality())
        after, least = quality(), 0
        while size is not None and len(data) > size:
            if len(rest) == 1:
                raise InputError(f"{run.folder} as {kind}: {few}")
            count = 1 + (len(rest) - 1) * (size - header) // (len(data) - header)
            (rest, data), after = fitted(max(count, len(rest) // 2)), quality()
        while psnr is not None and len(rest) - least > max(1, len(rest) // CLOSE):
            some, smaller = fitted((least + len(rest)) // 2)
            if (value := quality()) >= psnr:
                rest, data, after = some, smaller, value
            else:
                least = len(some)
    return Compacted(data, len(rest), (before, after))


def thinned(run: Run, whole: bool) -> Iterator[tuple[Gaussians, np.ndarray]]:
    """The run's model whole, or what it shows (`Run.shown`) pruned, then with a half to a sixteenth
    of these Gaussians, fitted once more if the prior's folder exists; each with their indices."""
    from mgs.fit.pruning import fewest, prune

    g, cameras = run.state.gaussians, [frame.camera for frame in run.taken]
    kept = rest = np.arange(len(g))
    report("removing Gaussians")
    if not whole:
        kept = np.flatnonzero(run.shown)
        g = g[kept]
        rest = prune(g, cameras, PRUNE_NOISE).kept
    yield g[rest], kept[rest]
    again = refitting(run) if run.settings.prior.is_dir() else None
    for _ in range(THINNINGS):
        count = max(1, len(g) // 2)
        rest = fewest(g, cameras, count)
        g, kept = g[rest], kept[rest]
        if again is not None:
            report(f"fitting {count:,} Gaussians")
            g = again(g)
        yield g, kept


def encoding(run: Run, shared: bool) -> Callable[..., Encoder]:
    """A function (model, indices in the run's, header of the file whose positions it has or None)
    -> encoder of models of `thinned`. Raises InputError as `compact_run`."""
    g, place = run.state.gaussians, (run.dataset.world.up, run.dataset.world.origin)
    start = _start(run, g) if shared or run.settings.prior.is_dir() else None
    gradients = partial(_gradients, run)
    if shared:
        if start is None:
            moved = "its fit moved the Gaussians of its prior or has others"
            raise InputError(f"{run.folder}: {moved}; leave out `shared_prior`")
        return lambda some, kept, placed=None: Encoder(some, gradients, start, kept, None, *place)
    layer = start.layer if start else np.zeros(len(g), np.int64)

    def alone(some: Gaussians, kept: np.ndarray, placed: Header | None = None) -> Encoder:
        # What a file gives is in the order of its codes, whose first bit is the layer.
        layers = np.sort(layer[kept]) if placed else layer[kept]
        return Encoder(some, gradients, None, None, layers, *place, placed)

    return alone


def _start(run: Run, g: Gaussians) -> Start | None:
    """Anchors of a run's Gaussians on its prior; None if they are elsewhere."""
    prior, count = run.prior, len(run.prior.points)
    if prior.kind == "random" or len(g) != count + prior.backed:
        return None
    inset = ((prior.points - g.means[:count]) * prior.normals).sum(1).mean()
    start = start_of(prior, float(inset))
    near = np.abs(start.means - g.means).max() < prior.spacing / 100
    return start if near else None


def _gradients(run: Run, g: Gaussians) -> Iterator[Mapping[str, np.ndarray]]:
    """Gradients of sum(z image) in sRGB, in which PSNR is measured, of up to VIEWS views."""
    from mgs.splat import as_drjit, render, vjp

    model, rng = as_drjit(g), generator(0, "compact")
    frames = run.taken[:: -(-len(run.taken) // VIEWS)]
    weight = np.sqrt(len(run.taken) / len(frames))
    for frame in frames:
        image = np.asarray(render(model, frame.camera).rgb)
        slope = np.ones_like(image)
        if g.linear:  # derivative of sRGB by linear RGB, 0 where it is clipped
            slope = (srgb_from_linear(image + STEP) - srgb_from_linear(image)) / STEP
        signs = rng.choice([-weight, weight], image.shape)
        yield vjp(model, (signs * slope).astype(np.float32), frame.camera)


def _fitted(
    encoder: Encoder, size: int | None, enough: Callable[[Gaussians], bool] | None
) -> Compact | None:
    """File of the finest steps that fit into `size` bytes, or the coarsest that give `enough`, or
    None. Too small a size is filled with the first packets."""
    low, high = np.log(SCALES)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        file = encoder.file(float(np.exp(middle)))
        if enough(file.model) if enough else len(file) > (size or 0):
            low = middle
        else:
            high = middle
    file = encoder.file(float(np.exp(low if enough else high)))
    if enough:
        return file if enough(file.model) else None
    first = file.first(size or 0)
    return first if first.payloads else None
