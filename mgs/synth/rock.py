"""Rocks as textured meshes that stand in the ground z = 0: procedural, by band-limited noise, or
from a mesh file."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from mgs.colour import srgb_from_linear
from mgs.data.meshes import GLTF, distinct_faces, load_mesh
from mgs.errors import InputError
from mgs.rotation import WORLD_FROM_GLTF
from mgs.synth.scene_file import Rock

LATTICE = 96  # samples along one side of the periodic noise volume
PERIOD = 16  # side of the noise volume in units of the shortest wavelength of its noise


class Noise:
    """Gaussian noise in space, zero mean, unit variance, of one octave: wavelengths 1 to 2.

    White noise in a periodic volume, band-passed in Fourier space, so that octaves of different
    scale share no frequencies (as wavelet noise, Cook and DeRose 2005); interpolated linearly."""

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


MAX_GRID = 10**8  # most points of the grid of a rock's body: more would take tens of gigabytes
CELL = 6  # texels along one side of a cell of the texture; two triangles share a cell


def make_rock(settings: Rock, rng: np.random.Generator) -> trimesh.Trimesh:
    """Weathered procedural rock: ellipsoids cut by planes, marching cubes, displacement, albedo.
    Returns a mesh in the world (metres, +Z up), partly below z = 0, with UVs and an sRGB texture.
    Raises InputError if `detail` is too coarse or too fine for the rock."""
    noise = Noise(rng)
    mesh, height = rock_shape(settings, noise)
    return _bake(mesh, height, settings, noise)


def rock_shape(settings: Rock, noise: Noise) -> tuple[trimesh.Trimesh, np.ndarray]:
    """The rock without texture, standing in the ground; displacement of each vertex [V], m."""
    mesh = _body(settings, noise).subdivide()
    height = _relief(mesh, settings, noise)
    mesh.vertices += height[:, None] * mesh.vertex_normals
    return _stand(mesh, settings), height


def up_axis(path: str | Path) -> str:
    """Default up axis of a mesh file, "y" or "z": glTF and GLB are +Y up by their format; OBJ is
    taken as +Y, as most are; all others as +Z."""
    return "y" if Path(path).suffix.lower() in (*GLTF, ".obj") else "z"


def load_rock(
    path: str | Path, settings: Rock, up: str | None = None
) -> tuple[trimesh.Trimesh, float]:
    """Read a mesh file as the rock, with its texture, scale it to `settings.size` and stand it in
    the ground.

    up: "y" or "z", by default `up_axis`. Returns the mesh, +Z up, and the scale. Faces without area
    and repeated faces are removed: normals of opposite faces cancel, and a vertex without normal
    has no shading. Raises InputError as `load_mesh`, and if all vertices are one point or at one
    height."""
    mesh = load_mesh(path)
    _leave_out_bad_faces(mesh)
    if mesh.extents.max() == 0:
        raise InputError(f"{path}: all vertices are one point; repair the mesh")
    if (up or up_axis(path)) == "y":
        mesh.apply_transform(WORLD_FROM_GLTF)
    scale = settings.size / float(mesh.extents.max())
    mesh = _stand(mesh, settings)
    if mesh.bounds[1, 2] <= 0:
        raise InputError(f"{path}: is flat on the ground; give a rock with a height, or `mesh_up`")
    return mesh, scale


def _leave_out_bad_faces(mesh: trimesh.Trimesh) -> None:
    """Remove, in place, all but the `distinct_faces`, and unused vertices. Vertices of removed
    faces get new normals, since opposite faces may have spoilt theirs; all others keep the file's.
    """
    faces = distinct_faces(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))
    if len(faces) == len(mesh.faces):
        return
    normals, spoilt = mesh.vertex_normals.copy(), np.unique(np.delete(mesh.faces, faces, axis=0))
    mesh.update_faces(faces)
    normals[spoilt] = mesh.vertex_normals[spoilt]
    mesh.vertex_normals = normals  # type: ignore[method-assign]  # a property
    mesh.remove_unreferenced_vertices()


def _stand(mesh: trimesh.Trimesh, settings: Rock) -> trimesh.Trimesh:
    """Scale a mesh to its size, centre it over the origin, bury the share `buried`."""
    mesh.apply_scale(settings.size / mesh.extents.max())
    low, high = mesh.bounds
    middle = (low + high) / 2
    mesh.apply_translation([-middle[0], -middle[1], -low[2] - settings.buried * (high - low)[2]])
    return mesh


def _body(settings: Rock, noise: Noise) -> trimesh.Trimesh:
    """Ellipsoids, cut by random planes, joined smoothly, meshed, scaled to the settings' size."""
    low = np.min([np.subtract(lobe.centre, lobe.radii) for lobe in settings.lobes], axis=0)
    high = np.max([np.add(lobe.centre, lobe.radii) for lobe in settings.lobes], axis=0)
    extent = float((high - low).max())
    # Edges of marching cubes are 0.9 steps long, and are halved.
    step = 2.2 * settings.detail / settings.size * extent
    origin = low - 0.15 * extent
    shape = np.ceil((high - low + 0.3 * extent) / step) + 1
    if shape.prod() > MAX_GRID:
        fine = f"rock.detail {settings.detail} m is too fine for a rock of {settings.size} m"
        raise InputError(f"scene: {fine}; raise it")
    shape = shape.astype(int)
    nodes = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
    points = (origin + step * nodes).astype(np.float32)
    points += 0.05 * np.stack([noise.octave(points, 1.1) for _ in range(3)], -1)
    distance = np.full(shape, 1e3)
    for lobe in settings.lobes:
        local = (points - np.asarray(lobe.centre, np.float32)) / np.asarray(lobe.radii, np.float32)
        inside = np.linalg.norm(local, axis=-1) - 1
        for normal in noise.rng.standard_normal((settings.facets, 3)):
            along = local @ (normal / np.linalg.norm(normal)).astype(np.float32)
            plane = along - noise.rng.uniform(0.62, 0.92)
            inside = _smooth_max(inside, plane, 0.05)
        distance = -_smooth_max(-distance, -inside * min(lobe.radii), 0.12)
    distance = gaussian_filter(distance, 0.7)
    if distance.min() >= 0:  # nothing is inside
        coarse = f"rock.detail {settings.detail} m is too coarse for a rock of {settings.size} m"
        raise InputError(f"scene: {coarse}; lower it")
    vertices, faces, _, _ = marching_cubes(distance, 0.0, spacing=(step,) * 3)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh = max(mesh.split(only_watertight=False), key=lambda part: len(part.faces))
    mesh.apply_scale(settings.size / mesh.extents.max())
    return mesh


def _smooth_max(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Maximum of a and b, rounded off where they differ by less than `width` (polynomial)."""
    h = np.clip(0.5 + 0.5 * (a - b) / width, 0, 1)
    return b + (a - b) * h + width * h * (1 - h)


def _relief(mesh: trimesh.Trimesh, settings: Rock, noise: Noise) -> np.ndarray:
    """Displacement along the vertex normals [V], metres."""
    p = np.asarray(mesh.vertices, np.float32)
    size, amplitude = settings.size, settings.relief * settings.size
    warp = np.stack([noise.fractal(p, 0.4 * size, 2) for _ in range(3)], -1)
    warped = p + 0.06 * size * warp.astype(np.float32)
    broken = np.clip(0.6 + 0.5 * noise.octave(p, 0.5 * size), 0.15, 1.3)
    swells = noise.fractal(p, 0.5 * size, 2)
    height = amplitude * (0.2 * swells - 0.15 * noise.fractal(warped, 0.3 * size, 2, ridged=True))
    faces = 0.4 * noise.fracture(warped, 0.3 * size)
    height += amplitude * (faces + 0.18 * broken * noise.fracture(warped, 0.11 * size))
    fine = 0.06 * noise.fracture(p, 0.04 * size) + 0.05 * noise.fractal(p, 0.045 * size, 4, 0.75)
    height += amplitude * broken * fine
    height -= 0.006 * size * np.clip(noise.octave(p, 0.045 * size) - 1.5, 0, 1)
    crack = np.exp(-((noise.octave(warped, 0.8 * size) / 0.025) ** 2))
    crack = crack + 0.6 * np.exp(-((noise.octave(warped, 0.5 * size) / 0.03) ** 2))
    height -= settings.cracks * size * crack * np.clip(0.5 + noise.octave(p, 0.6 * size), 0, 1)
    if settings.layers:
        z = p[:, 2]
        level = settings.layers * (z - z.min()) / np.ptp(z) + 0.35 * noise.fractal(p, 0.8 * size, 3)
        height += 0.009 * size * _smoothstep(0.3, 0.6, np.abs(2 * (level % 1) - 1))
    return height


def _bake(
    mesh: trimesh.Trimesh, height: np.ndarray, settings: Rock, noise: Noise
) -> trimesh.Trimesh:
    """The mesh with a texture of its albedo, in which every two triangles have a square cell. The
    albedo is a function of position, evaluated at every texel. No unwrapping is needed, so this
    works for any shape and stretches nothing. The result's faces share no vertices."""
    n_faces = len(mesh.faces)
    cells = np.arange((n_faces + 1) // 2)
    across = int(np.ceil(np.sqrt(len(cells))))
    # The right angle of a cell's first triangle is at its origin; the second is turned by 180°.
    j, i = (a.ravel() for a in np.mgrid[:CELL, :CELL])
    second = i + j > CELL - 1
    u, v = (np.where(second, CELL - 1 - a, a) / (CELL - 2) for a in (i, j))
    weights = np.stack([1 - u - v, u, v], -1).astype(np.float32)
    face = np.minimum(2 * cells[:, None] + second, n_faces - 1)

    def at_texels(values: np.ndarray) -> np.ndarray:
        w = weights.reshape(*weights.shape, *[1] * (values.ndim - 1))
        a, b, c = (values.astype(np.float32)[mesh.faces[:, k]][face] for k in range(3))
        return w[:, 0] * a + w[:, 1] * b + w[:, 2] * c

    points, normals = at_texels(mesh.vertices), at_texels(mesh.vertex_normals)
    colour = _albedo(points, normals, at_texels(height), settings, noise)
    texture = np.zeros((across * CELL, across * CELL, 3), np.float32)
    row, column = CELL * (cells // across)[:, None] + j, CELL * (cells % across)[:, None] + i
    texture[row, column] = colour

    first = np.array([[0, 0], [CELL - 2, 0], [0, CELL - 2]])
    corners = np.stack([first, CELL - 1 - first])[np.arange(n_faces) % 2] + 0.5
    cell = np.arange(n_faces) // 2
    uv = (corners + CELL * np.stack([cell % across, cell // across], -1)[:, None]) / (across * CELL)
    uv[..., 1] = 1 - uv[..., 1]  # in trimesh v points upwards from the image's last row
    image = Image.fromarray(np.round(255 * srgb_from_linear(texture)).astype(np.uint8))
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=image, metallicFactor=0.0, roughnessFactor=0.9
    )
    return trimesh.Trimesh(
        mesh.vertices[mesh.faces].reshape(-1, 3),
        np.arange(3 * n_faces).reshape(-1, 3),
        vertex_normals=mesh.vertex_normals[mesh.faces].reshape(-1, 3),
        visual=trimesh.visual.TextureVisuals(uv=uv.reshape(-1, 2), material=material),
        process=False,
    )


def _albedo(
    p: np.ndarray, normal: np.ndarray, height: np.ndarray, settings: Rock, noise: Noise
) -> np.ndarray:
    """Albedo, linear RGB [..., 3], at points p [..., 3], metres: two minerals, grains, dark
    hollows, and dust on what faces up. normal [..., 3]: unit; height [...]: displacement of
    `_relief`, metres."""
    size = settings.size
    light, dark, dust = (np.asarray(c, np.float32) for c in (*settings.colours, settings.dust))
    patches = noise.fractal(p, 0.5 * size, 4, 0.6)
    if settings.layers:
        level = settings.layers * p[..., 2] / size + 0.25 * noise.fractal(p, 0.6 * size, 4)
        band = np.sin(2 * np.pi * level) + 0.8 * np.sin(2 * np.pi * 2.7 * level + 1)
        patches = 0.4 * patches + 1.3 * band
    mix = _smoothstep(-1.2, 1.2, patches)
    grains = 0.15 * noise.fractal(p, 0.02 * size, 3, 0.9)
    grains = grains - 0.35 * _smoothstep(1.5, 2.2, noise.octave(p, 0.012 * size))
    hollow = _smoothstep(1.0, -2.5, height / (settings.relief * size + 1e-9) * 3)
    if settings.plain_half:
        textured = _smoothstep(-0.05, 0.05, p[..., 0] / size)
        mix, grains = 0.6 + textured * (mix - 0.6), textured * grains
    colour = dark + (light - dark) * mix[..., None]
    colour = colour * (1 + grains - 0.35 * hollow)[..., None]
    upward = normal[..., 2] + 0.3 * noise.fractal(p, 0.12 * size, 4, 0.7)
    settled = 0.65 * _smoothstep(0.4, 1.1, upward)
    return np.clip(colour + (dust - colour) * settled[..., None], 0.01, 0.9)


def _smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """Cubic curve from 0 at x = low to 1 at x = high, constant beyond."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)
