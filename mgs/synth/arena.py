"""The ground of a scene: undulating regolith and scattered stones."""

import numpy as np
import trimesh

from mgs.synth.rock import Noise, rock_shape, tile
from mgs.synth.scene_file import Arena, Lobe, Rock

REACH = 400.0  # half the side of the square terrain, metres; its edge looks like the horizon
ROWS = 480  # vertices along one side of the terrain, about 3 cm apart near the rock
TILE = 4.0  # side of the regolith's texture tile, metres
TEXELS = 1024  # texels along one side of the tile


def _grid() -> np.ndarray:
    u = np.linspace(-1, 1, ROWS)
    return 7 * u + (REACH - 7) * u**9


def make_ground(
    settings: Arena, rock: trimesh.Trimesh, rng: np.random.Generator
) -> trimesh.Trimesh:
    """Terrain mesh, metres, z about 0: swells, far dunes, ripples, and dust at the rock's foot. UVs
    are in units of a texture tile. Vertex attribute `blend` [V,1], 0 to 1: weight of the second
    tile of `regolith`."""
    noise = Noise(rng)
    x, y = np.meshgrid(_grid(), _grid())
    p = np.stack([x, y, np.zeros_like(x)], -1).astype(np.float32)
    far = np.hypot(x, y)
    foot = rock.vertices[np.abs(rock.vertices[:, 2]) < 0.1 * rock.extents[2]][:, :2]
    radius = np.linalg.norm(foot, axis=1).mean() if len(foot) else 0.5 * rock.extents[:2].mean()
    # Fine detail fades out as the grid gets coarser, and dunes replace it.
    swell = settings.undulation * noise.fractal(p, 2.5, 4, 0.45) * np.exp(-far / 12)
    swell += (0.3 + 10 * settings.undulation) * noise.octave(p, 40) * np.clip(far / 50 - 0.2, 0, 1)
    # Hills at the edge hide the sky below its horizon, which is black.
    swell += 5 * np.clip(far / 200 - 1, 0, 1) ** 2
    ripples = 0.006 * noise.fractal(p, 0.3, 2, 0.6) * (far < 7)
    apron = 0.05 * np.exp(-(((far - radius) / (0.35 * radius)) ** 2))
    vertices = np.stack([x, y, swell + ripples + apron], -1).reshape(-1, 3)

    a = (np.arange(ROWS - 1)[:, None] * ROWS + np.arange(ROWS - 1)).ravel()
    b, c, d = a + 1, a + ROWS, a + ROWS + 1
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    visual = trimesh.visual.TextureVisuals(uv=vertices[:, :2] / TILE)
    mesh = trimesh.Trimesh(vertices, faces, visual=visual, process=False)
    blend = 0.5 + 0.5 * noise.fractal(p, 1.8, 5, 0.75)
    mesh.vertex_attributes["blend"] = np.clip(blend, 0, 1).reshape(-1, 1).astype(np.float32)
    return mesh


def regolith(settings: Arena, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Two seamless tiles, linear RGB [TEXELS,TEXELS,3]: pale dust, and darker grains."""
    fine, soft, tint = (tile(TEXELS, exponent, rng) for exponent in (0.35, 1.1, 1.3))
    grains = np.clip(tile(TEXELS, 0.2, rng, shortest=4) - 1.4, 0, 1)
    colour = np.asarray(settings.colour, np.float32)
    hue = 1 + 0.04 * tint[..., None] * np.array([1, 0, -1], np.float32)
    drift = colour * (1.04 + 0.16 * fine + 0.06 * soft)[..., None] * hue
    lag = 0.92 * colour * (1 + 0.3 * fine + 0.08 * soft - 0.6 * grains)[..., None] * hue
    return np.clip(drift, 0.02, 0.9), np.clip(lag, 0.02, 0.9)


def make_stones(
    settings: Arena, rock: trimesh.Trimesh, ground: trimesh.Trimesh, rng: np.random.Generator
) -> trimesh.Trimesh | None:
    """Small stones scattered over the ground, one mesh with the vertex attribute `color` (linear
    RGB). None if the settings ask for no stones, or leave no room between clearance and
    `spread`."""
    if not settings.stones:
        return None
    noise = Noise(rng)
    fine, coarse = ([_stone(noise, detail) for _ in range(8)] for detail in (0.04, 0.08))
    above = rock.vertices[rock.vertices[:, 2] > 0]
    keep_out = settings.clearance * np.linalg.norm(above[:, :2], axis=1).max()
    distance = settings.spread * rng.uniform(0, 1, 4 * settings.stones) ** 0.7
    azimuth = rng.uniform(0, 2 * np.pi, 4 * settings.stones)
    at = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth)], 1)
    at = at[distance > keep_out][: settings.stones]
    if len(at) == 0:
        return None
    # Broken rock follows a power law: the number of stones larger than s grows as s^-1.8.
    sizes = 0.6 * settings.stone_size * rng.uniform(0, 1, len(at)) ** (-1 / 1.8)
    sizes = np.minimum(sizes, settings.largest_stone)
    vertices, faces, colours, offset = [], [], [], 0
    for position, height, size in zip(at, _height_at(ground, at), sizes, strict=True):
        stone = (fine if size > 0.15 else coarse)[rng.integers(8)]
        turn = rng.uniform(0, 2 * np.pi)
        c, s = np.cos(turn), np.sin(turn)
        corners = stone.vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        vertices.append(corners * size + [*position, height])
        faces.append(stone.faces + offset)
        tone = np.asarray(settings.colour) * rng.uniform(0.35, 1.1)
        grey = tone + (tone.mean() - tone) * rng.uniform(0, 0.8)
        colours.append(np.broadcast_to(grey, (len(corners), 3)))
        offset += len(corners)
    mesh = trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)
    mesh.vertex_attributes["color"] = np.concatenate(colours).astype(np.float32)
    return mesh


def _stone(noise: Noise, detail: float) -> trimesh.Trimesh:
    """One stone of size 1, a quarter of its height below z = 0, without texture."""
    lobe = Lobe(radii=(1.0, noise.rng.uniform(0.6, 0.9), noise.rng.uniform(0.4, 0.7)))
    rock = Rock(size=1.0, lobes=(lobe,), detail=detail, buried=0.25, cracks=0, relief=0.08)
    return rock_shape(rock, noise)[0]


def _height_at(ground: trimesh.Trimesh, at: np.ndarray) -> np.ndarray:
    """Height of the terrain [N], metres, at points (x, y) [N,2], interpolated bilinearly."""
    u = np.interp(at, _grid(), np.arange(ROWS))
    i = np.clip(u.astype(int), 0, ROWS - 2)
    (ix, iy), (fx, fy) = i.T, (u - i).T
    z = ground.vertices[:, 2].reshape(ROWS, ROWS)
    low = z[iy, ix] * (1 - fx) + z[iy, ix + 1] * fx
    return low * (1 - fy) + (z[iy + 1, ix] * (1 - fx) + z[iy + 1, ix + 1] * fx) * fy
