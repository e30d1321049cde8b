"""Band-limited noise: the one texture primitive that rocks, regolith and albedo are made of."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

LATTICE = 96
"""Samples along one side of the periodic noise volume."""

PERIOD = 16
"""Noise periods (wavelengths of the finest detail) along one side of the volume."""


class Noise:
    """A seeded scalar field in space: Gaussian white noise of one octave (wavelengths 1 to 2), zero mean, unit variance.

    The octave is cut out in Fourier space (as wavelet noise does; Cook and DeRose 2005), so octaves add without beating,
    and is looked up trilinearly in a periodic volume.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        k = np.fft.fftfreq(LATTICE, PERIOD / LATTICE)
        radius = np.sqrt(k[:, None, None] ** 2 + k[None, :, None] ** 2 + k[None, None, :] ** 2)
        spectrum = np.fft.fftn(rng.standard_normal((LATTICE,) * 3)) * ((radius >= 0.5) & (radius < 1))
        volume = np.fft.ifftn(spectrum).real
        self.volume = (volume / volume.std()).astype(np.float32)

    def octave(self, points: np.ndarray, wavelength: float) -> np.ndarray:
        """Noise at points [..., 3] with features of about `wavelength` (same unit) -> float32 [...].

        Each call looks through a new random rotation and offset, so octaves and layers are independent.
        """
        rotation = np.linalg.qr(self.rng.standard_normal((3, 3)))[0]
        offset = self.rng.uniform(0, LATTICE, 3).astype(np.float32)
        coordinates = np.asarray(points, np.float32) @ (rotation * (LATTICE / PERIOD / wavelength)).astype(np.float32) + offset
        return map_coordinates(self.volume, np.moveaxis(coordinates, -1, 0), order=1, mode="grid-wrap", prefilter=False)

    def fractal(self, points: np.ndarray, wavelength: float, octaves: int, gain: float = 0.5) -> np.ndarray:
        """Sum of `octaves` octaves, each of half the wavelength and `gain` times the amplitude of the one before."""
        return sum((gain**i * self.octave(points, wavelength / 2**i) for i in range(octaves)), np.zeros(points.shape[:-1]))

    def ridged(self, points: np.ndarray, wavelength: float, octaves: int, gain: float = 0.5) -> np.ndarray:
        """As `fractal`, of 1 - |noise|: sharp crests, zero mean (roughly)."""
        octave = (gain**i * (0.8 - np.abs(self.octave(points, wavelength / 2**i))) for i in range(octaves))
        return sum(octave, np.zeros(points.shape[:-1]))

    def fracture(self, points: np.ndarray, wavelength: float) -> np.ndarray:
        """Piecewise linear field at points [N,3], about -1 to 1: Voronoi cells of a `wavelength`, each a tilted plane.

        Flat faces, narrow edges and ledges, as broken rock has (cells: Worley 1996).
        """
        low, high = points.min(0) - wavelength, points.max(0) + wavelength
        centres = self.rng.uniform(low, high, (int(np.prod((high - low) / wavelength)) + 4, 3))
        tilt = self.rng.normal(size=centres.shape)
        distance, nearest = cKDTree(centres).query(points, 4)
        weight = np.exp(-(distance - distance[:, :1]) / (0.08 * wavelength))
        height = np.einsum("nck,nck->nc", points[:, None] - centres[nearest], tilt[nearest]) / wavelength
        return (weight * height).sum(1) / weight.sum(1)


def tile(size: int, exponent: float, rng: np.random.Generator, shortest: float = 2) -> np.ndarray:
    """A periodic image [size,size] of Gaussian noise, zero mean, unit variance, amplitude falling as frequency^-exponent.

    Nothing is finer than `shortest` pixels.
    """
    k = np.fft.fftfreq(size)
    frequency = np.hypot(k[:, None], k[None, : size // 2 + 1])
    frequency[0, 0] = np.inf
    amplitude = np.where(frequency <= 1 / shortest, frequency**-exponent, 0)
    image = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) * amplitude)
    return ((image - image.mean()) / image.std()).astype(np.float32)
