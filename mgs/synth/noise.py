"""Band-limited noise for the shape and colour of rocks and ground."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

LATTICE = 96  # samples along one side of the periodic noise volume
PERIOD = 16  # side of the noise volume in units of the shortest wavelength of its noise


class Noise:
    """Gaussian noise in space, zero mean, unit variance, of one octave: wavelengths 1 to 2.

    White noise in a periodic volume, band-passed in Fourier space, so that octaves of different
    scale share no frequencies (as wavelet noise, Cook and DeRose 2005); interpolated linearly.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng, self.threads = rng, ThreadPoolExecutor(2)
        k = np.fft.fftfreq(LATTICE, PERIOD / LATTICE)
        radius = np.sqrt(k[:, None, None] ** 2 + k[None, :, None] ** 2 + k[None, None, :] ** 2)
        spectrum = np.fft.fftn(rng.standard_normal((LATTICE,) * 3))
        volume = np.fft.ifftn(spectrum * ((radius >= 0.5) & (radius < 1))).real
        self.volume = (volume / volume.std()).astype(np.float32)

    def octave(self, points: np.ndarray, wavelength: float) -> np.ndarray:
        """Noise at points [..., 3], float32 [...]; wavelength: the shortest, in the unit of the
        points. Each call rotates and shifts the points at random, so calls are independent."""
        rotation = np.linalg.qr(self.rng.standard_normal((3, 3)))[0]
        offset = self.rng.uniform(0, LATTICE, 3).astype(np.float32)
        turn = (rotation * (LATTICE / PERIOD / wavelength)).astype(np.float32)
        at = np.moveaxis(np.asarray(points, np.float32) @ turn + offset, -1, 0)
        value = partial(map_coordinates, self.volume, order=1, mode="grid-wrap", prefilter=False)
        halves = self.threads.map(value, np.array_split(at.reshape(3, -1), 2, axis=1))
        return np.concatenate(list(halves)).reshape(at.shape[1:])

    def fractal(
        self,
        points: np.ndarray,
        wavelength: float,
        octaves: int,
        gain: float = 0.5,
        ridged: bool = False,
    ) -> np.ndarray:
        """Sum of octaves, each of half the wavelength and `gain` times the amplitude of the one
        before. ridged: of 0.8 - |noise| in place of noise: sharp crests, mean about zero."""
        total = np.zeros(points.shape[:-1])
        for i in range(octaves):
            octave = self.octave(points, wavelength / 2**i)
            total = total + gain**i * (0.8 - np.abs(octave) if ridged else octave)
        return total

    def fracture(self, points: np.ndarray, wavelength: float) -> np.ndarray:
        """Field [N], about -1 to 1, linear within each of many cells: flat faces and narrow edges,
        as of broken rock. points [N,3]; wavelength: mean distance of the cells, in their unit.
        Cells of a Voronoi diagram of random centres (Worley 1996), each with a random slope."""
        low, high = points.min(0) - wavelength, points.max(0) + wavelength
        centres = self.rng.uniform(low, high, (int(np.prod((high - low) / wavelength)) + 4, 3))
        tilt = self.rng.normal(size=centres.shape)
        distance, nearest = cKDTree(centres).query(points, 4)
        weight = np.exp(-(distance - distance[:, :1]) / (0.08 * wavelength))
        offset = points[:, None] - centres[nearest]
        height = np.einsum("nck,nck->nc", offset, tilt[nearest]) / wavelength
        return (weight * height).sum(1) / weight.sum(1)


def tile(size: int, exponent: float, rng: np.random.Generator, shortest: float = 2) -> np.ndarray:
    """Periodic image [size,size], float32, of Gaussian noise, zero mean, unit variance, amplitude
    proportional to frequency^-exponent and zero for wavelengths below `shortest` pixels."""
    k = np.fft.fftfreq(size)
    frequency = np.hypot(k[:, None], k[None, : size // 2 + 1])
    frequency[0, 0] = np.inf
    amplitude = np.where(frequency <= 1 / shortest, frequency**-exponent, 0)
    image = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) * amplitude)
    return ((image - image.mean()) / image.std()).astype(np.float32)
