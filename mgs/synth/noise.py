"""Band-limited noise: the shape and the colours of rocks and ground are all made of it."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

LATTICE = 96
"""Samples along one side of the periodic noise volume."""

PERIOD = 16
"""Side of the noise volume in units of the shortest wavelength of its noise."""


class Noise:
    """A random scalar field in space: Gaussian noise with zero mean and unit variance, of one
    octave, wavelengths 1 to 2.

    It is white noise in a periodic volume, of which all other frequencies are removed in Fourier
    space. Sums of octaves of different scale then share no frequencies (the idea of wavelet noise,
    Cook and DeRose 2005). Values between the samples of the volume are interpolated linearly.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        k = np.fft.fftfreq(LATTICE, PERIOD / LATTICE)
        radius = np.sqrt(k[:, None, None] ** 2 + k[None, :, None] ** 2 + k[None, None, :] ** 2)
        spectrum = np.fft.fftn(rng.standard_normal((LATTICE,) * 3)) * (
            (radius >= 0.5) & (radius < 1)
        )
        volume = np.fft.ifftn(spectrum).real
        self.volume = (volume / volume.std()).astype(np.float32)

    def octave(self, points: np.ndarray, wavelength: float) -> np.ndarray:
        """Noise at points [..., 3], float32 [...]; `wavelength` is the shortest wavelength, in the
        unit of the points.

        Every call turns and shifts the points at random before it looks them up, so the results of
        calls are independent.
        """
        rotation = np.linalg.qr(self.rng.standard_normal((3, 3)))[0]
        offset = self.rng.uniform(0, LATTICE, 3).astype(np.float32)
        coordinates = (
            np.asarray(points, np.float32)
            @ (rotation * (LATTICE / PERIOD / wavelength)).astype(np.float32)
            + offset
        )
        return map_coordinates(
            self.volume, np.moveaxis(coordinates, -1, 0), order=1, mode="grid-wrap", prefilter=False
        )

    def fractal(
        self, points: np.ndarray, wavelength: float, octaves: int, gain: float = 0.5
    ) -> np.ndarray:
        """Sum of so many calls of `octave`, each of half the wavelength and `gain` times the
        amplitude of the one before."""
        return sum(
            (gain**i * self.octave(points, wavelength / 2**i) for i in range(octaves)),
            np.zeros(points.shape[:-1]),
        )

    def ridged(
        self, points: np.ndarray, wavelength: float, octaves: int, gain: float = 0.5
    ) -> np.ndarray:
        """The same sum as `fractal`, of 0.8 - |noise| in place of noise: it has sharp crests, and a
        mean of about zero."""
        octave = (
            gain**i * (0.8 - np.abs(self.octave(points, wavelength / 2**i))) for i in range(octaves)
        )
        return sum(octave, np.zeros(points.shape[:-1]))

    def fracture(self, points: np.ndarray, wavelength: float) -> np.ndarray:
        """A field [N], about -1 to 1, that is linear within each of many cells: flat faces and
        narrow edges, as of broken rock.

        points [N,3]; wavelength: mean distance of the cells, in the unit of the points. The cells
        are those of a Voronoi diagram of random centres (Worley 1996), and each has a random slope.
        """
        low, high = points.min(0) - wavelength, points.max(0) + wavelength
        centres = self.rng.uniform(low, high, (int(np.prod((high - low) / wavelength)) + 4, 3))
        tilt = self.rng.normal(size=centres.shape)
        distance, nearest = cKDTree(centres).query(points, 4)
        weight = np.exp(-(distance - distance[:, :1]) / (0.08 * wavelength))
        height = (
            np.einsum("nck,nck->nc", points[:, None] - centres[nearest], tilt[nearest]) / wavelength
        )
        return (weight * height).sum(1) / weight.sum(1)


def tile(size: int, exponent: float, rng: np.random.Generator, shortest: float = 2) -> np.ndarray:
    """A periodic image [size,size], float32, of Gaussian noise with zero mean and unit variance.

    Its amplitude is proportional to frequency^-exponent, and zero for wavelengths below `shortest`
    pixels.
    """
    k = np.fft.fftfreq(size)
    frequency = np.hypot(k[:, None], k[None, : size // 2 + 1])
    frequency[0, 0] = np.inf
    amplitude = np.where(frequency <= 1 / shortest, frequency**-exponent, 0)
    image = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) * amplitude)
    return ((image - image.mean()) / image.std()).astype(np.float32)
