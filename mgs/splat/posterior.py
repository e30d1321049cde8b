"""Fisher information of many views as an operator: products, solutions, log-determinant and samples
of the posterior. H = sum over the views of J^T W J has a row for each of P N parameters and couples
all Gaussians that share a pixel; `fisher` gives its diagonal blocks alone. A product H v takes two
passes a view."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import prod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mgs.camera import Camera
from mgs.errors import InputError
from mgs.gaussians import Gaussians, learned
from mgs.splat.information import fisher, groups, weights_of
from mgs.splat.jacobian import jvp, vjp
from mgs.splat.rendering import ListCache, as_drjit

Floats = NDArray[np.float64]

STEPS = 30  # most steps of the Lanczos iteration of a probe. A chosen constant.
TOLERANCE = 1e-3  # residual over right-hand side, whitened by the blocks; float32 allows about 1e-5
MOST_STEPS = 1000  # most steps of the conjugate gradients


class Estimate(NamedTuple):
    """A random estimate and its standard error."""

    value: float
    error: float


@dataclass(frozen=True, eq=False)
class Information:
    """Fisher information H of the images of some cameras by the parameters of the Gaussians.

    - gaussians: N of them, of any fields that `render` takes. cameras: V of them.
    - background, means: as in `fisher`; P columns for each Gaussian, in its order.
    - weights: W of each camera, as in `fisher`, by default 1.
    - cache: pass the same one to all calls, to reuse the block lists of cameras.

    Raises InputError as `fisher`, and for vectors and lam of other shapes. Sources: Ubaru, Chen and
    Saad 2017 (stochastic Lanczos quadrature); Papandreou and Yuille 2010 (samples by
    perturbation)."""

    gaussians: Gaussians
    cameras: Sequence[Camera]
    background: Any = (0.0, 0.0, 0.0)
    means: str = "frozen"
    weights: Sequence[ArrayLike] | None = None
    cache: ListCache = field(default_factory=ListCache)

    def __post_init__(self) -> None:
        if self.weights is not None and len(self.weights) != len(self.cameras):
            why = f"weights must be {len(self.cameras)} arrays, one a camera"
            raise InputError(f"information: {why}")

    @cached_property
    def blocks(self) -> Floats:
        """Diagonal blocks of H [N,P,P]."""
        each = [None] * len(self.cameras) if self.weights is None else self.weights
        how = {"background": self.background, "cache": self.cache, "means": self.means}
        total: Any = 0.0
        for camera, weight in zip(self.cameras, each, strict=True):
            total = total + fisher(self._model, camera, "block", weights=weight, **how)
        n, size = self._shape
        return np.asarray(total, np.float64) if self.cameras else np.zeros((n, size, size))

    @property
    def _shape(self) -> tuple[int, int]:
        """N and P."""
        columns = groups(self.gaussians.sh_degree, self.means)
        return len(self.gaussians), list(columns.values())[-1].stop

    def _fitted(self, name: str, values: ArrayLike) -> Floats:
        """Numbers that broadcast to [N,P]. Raises InputError for others."""
        try:
            return np.broadcast_to(np.asarray(values, np.float64), self._shape)
        except (TypeError, ValueError):
            why = f"{name} must be numbers of shape {self._shape}, those of the parameters"
            raise InputError(f"information: {why}") from None

    @cached_property
    def _model(self) -> Gaussians:
        return as_drjit(self.gaussians)

    @cached_property
    def _roots(self) -> list[Any]:
        """Square root of the weights of each view, None or [H,W,3]."""
        each = [None] * len(self.cameras) if self.weights is None else self.weights
        weights = [weights_of(one, camera) for one, camera in zip(each, self.cameras, strict=True)]
        return [None if one is None else np.sqrt(one[..., :3]) for one in weights]

    def product(self, vector: ArrayLike) -> Floats:
        """H v [N,P] of v [N,P]."""
        total, tangents = np.zeros(self._shape), self._by_name(self._fitted("the vector", vector))
        for camera, root in zip(self.cameras, self._roots, strict=True):
            # J^T W J v, view by view.
            image = np.asarray(jvp(self._model, tangents, camera, self.background, self.cache).rgb)
            total += self._transposed(image if root is None else image * root * root, camera)
        return total

    def solve(self, vector: ArrayLike, lam: ArrayLike, tolerance: float = TOLERANCE) -> Floats:
        """(H + lam)^-1 v [N,P] of v [N,P], by conjugate gradients. lam: positive, [P], or what
        broadcasts to [N,P] (`regularisation`). tolerance: of the residual's norm, relative,
        whitened by the blocks. Raises InputError if MOST_STEPS do not reach it."""
        whiten, lam = self._whitening(lam)
        # Solve A y = b with A = L^-1 (H + lam) L^-T and b = L^-1 v; the solution is L^-T y.
        # x: y so far; r = b - A y, its residual; p: direction of the next step.
        b = whiten(self._fitted("the vector", vector), True)
        x, r, p = np.zeros_like(b), b, b
        square, enough = float((r * r).sum()), tolerance**2 * float((b * b).sum())
        for _ in range(MOST_STEPS):
            if square <= enough:
                return whiten(x, False)
            # x moves along p to the minimum of the quadratic; the next p is conjugate to it.
            image = self._whitened(p, whiten, lam)
            step = square / float((p * image).sum())
            x, r = x + step * p, r - step * image
            square, before = float((r * r).sum()), square
            p = r + square / before * p
        why = f"{MOST_STEPS} steps do not reach a residual of {tolerance:g}"
        raise InputError(f"information: {why}; raise the tolerance, or lam")

    def log_det(
        self, lam: ArrayLike, probes: int = 8, steps: int = STEPS, seed: int = 0
    ) -> Estimate:
        """log det(H + lam), nats, by stochastic Lanczos quadrature, and its standard error.

        lam: as in `solve`. With L L^T the blocks of H + lam, it is sum log diag(L)^2, exactly, plus
        trace log A with A = L^-1 (H + lam) L^-T. That trace is the mean of z^T log(A) z over
        `probes` random vectors z of +1 and -1, each by `steps` of the Lanczos iteration: the error
        is that of the mean. Half of z^T A z, whose mean is known, is subtracted, which leaves about
        two thirds of the error. Raises InputError for fewer than two probes or steps."""
        if probes < 2 or steps < 2:
            why = f"probes {probes}, steps {steps}: give at least 2 of each"
            raise InputError(f"information: {why}")
        whiten, lam = self._whitening(lam)
        rng, traces = np.random.default_rng(seed), []
        for _ in range(probes):
            z = rng.choice([-1.0, 1.0], self._shape)
            traces.append(z.size * self._log_quadratic(z / np.sqrt(z.size), steps, whiten, lam))
        # log det(H + lam) = log det(L L^T) + trace log A.
        blocks = np.linalg.slogdet(self._precision(lam))[1].sum()
        error = np.std(traces, ddof=1) / np.sqrt(probes)
        return Estimate(float(blocks + np.mean(traces)), float(error))

    def _log_quadratic(self, q: Floats, steps: int, whiten: Any, lam: Floats) -> float:
        """q^T (log(A) - A / 2) q + 1 / 2 of a unit vector, by the Gauss quadrature of its Lanczos
        matrix. A has blocks of 1, so the mean of q^T A q over random signs is 1."""
        # A Q = Q T with orthonormal Q and tridiagonal T: a its diagonal, b beside it.
        # Then q^T log(A) q is about e1^T log(T) e1 = sum over i of u_1i^2 log theta_i, with
        # theta_i the eigenvalues of T and u_1i the first entries of its eigenvectors.
        if q.size == 0:
            return 0.0
        basis, a, b = [q], list[float](), list[float]()
        for _ in range(min(steps, q.size)):
            w = self._whitened(basis[-1], whiten, lam)
            a.append(float((w * basis[-1]).sum()))
            for old in basis:  # orthogonal to all, as rounding would lose it
                w = w - (w * old).sum() * old
            b.append(float(np.linalg.norm(w)))
            if b[-1] < 1e-5 * abs(a[0]):
                break
            basis.append(w / b[-1])
        off = b[: len(a) - 1]
        values, vectors = np.linalg.eigh(np.diag(a) + np.diag(off, 1) + np.diag(off, -1))
        # No eigenvalue of A is below lam over the largest of the blocks; float32 may say so.
        return float((vectors[0] ** 2 * np.log(np.maximum(values, 1e-9))).sum() + (1 - a[0]) / 2)

    def samples(
        self,
        lam: ArrayLike,
        count: int = 8,
        pixel_noise: float = 0.02,
        seed: int = 0,
        tolerance: float = TOLERANCE,
    ) -> list[Gaussians]:
        """Draws from the posterior N(theta, sigma_e^2 (H + lam)^-1) of the parameters. lam,
        tolerance: as in `solve`. pixel_noise: sigma_e, that of lam. Each draw adds (H + lam)^-1
        (J^T W^1/2 e + lam^1/2 n) sigma_e with unit normal e and n, which has this covariance, at
        the cost of one `solve`."""
        rng, lam, draws = np.random.default_rng(seed), self._fitted("lam", lam), []
        for _ in range(count):
            # b = lam^1/2 n + J^T W^1/2 e has the covariance H + lam, so (H + lam)^-1 b its inverse.
            b = rng.standard_normal(self._shape) * np.sqrt(lam)
            for camera, root in zip(self.cameras, self._roots, strict=True):
                noise = rng.standard_normal((camera.height, camera.width, 3))
                b += self._transposed(noise if root is None else noise * root, camera)
            moves = self._by_name(pixel_noise * self.solve(b, lam, tolerance))
            old = {name: np.asarray(getattr(self.gaussians, name)) for name in moves}
            draws.append(replace(self.gaussians, **{k: old[k] + moves[k] for k in old}))
        return draws

    def _by_name(self, vector: np.ndarray) -> dict[str, np.ndarray]:
        """Parts of a vector [N,P] by parameter, float32 of its shape."""
        columns = groups(self.gaussians.sh_degree, self.means)
        shapes = {name: getattr(self.gaussians, name).shape for name in learned(self.means)}
        parts = zip(shapes.items(), columns.values(), strict=True)
        return {name: np.float32(vector[:, of]).reshape(shape) for (name, shape), of in parts}

    def _transposed(self, image: np.ndarray, camera: Camera) -> Floats:
        """J^T z [N,P] of an image z [H,W,3]."""
        names = list(learned(self.means))
        parts = vjp(self._model, image, camera, self.background, self.cache, names).values()
        flat = [np.float64(part).reshape(len(part), prod(part.shape[1:])) for part in parts]
        return np.concatenate(flat, 1)

    def _whitening(self, lam: ArrayLike) -> tuple[Any, Floats]:
        """Return whiten(v, transposed) -> L^-T v or, transposed, L^-1 v of v [N,P], with L L^T the
        blocks of H + lam; and lam."""
        lam = self._fitted("lam", lam)
        if not (lam > 0).all():
            raise InputError("information: lam must be positive, else the precision has no inverse")
        # L^-1 of each block.
        inverse = np.linalg.inv(np.linalg.cholesky(self._precision(lam)))

        def whiten(v: Floats, transposed: bool) -> Floats:
            return np.einsum("nij,nj->ni" if transposed else "nji,nj->ni", inverse, v)

        return whiten, lam

    def _whitened(self, v: Floats, whiten: Any, lam: Floats) -> Floats:
        """A v, with A = L^-1 (H + lam) L^-T."""
        inner = whiten(v, False)
        return np.asarray(whiten(self.product(inner) + lam * inner, True))

    def _precision(self, lam: Floats) -> Floats:
        """Diagonal blocks of H + lam [N,P,P]."""
        blocks = self.blocks.copy()
        np.einsum("nii->ni", blocks)[...] += lam  # a view of the diagonals
        return blocks
