"""The ground of a scene: undulating regolith and scattered stones."""

from __future__ import annotations

import numpy as np
import trimesh

from mgs.noise import Noise
from mgs.rock import make_rock
from mgs.scene_file import Arena, Lobe, Rock

REACH = 45.0
"""Half the side of the terrain, metres: its edge is the horizon."""
ROWS = 420
"""Vertices along one side of the terrain; their spacing grows outwards, 2 cm near the rock to metres at the horizon."""
TEXELS = 1600
"""Texels along one side of the regolith's texture."""


def make_ground(settings: Arena, rock: trimesh.Trimesh, rng: np.random.Generator) -> tuple[trimesh.Trimesh, np.ndarray]:
    """Terrain mesh (metres, z about 0) with UVs, and its albedo texture, linear RGB [TEXELS, TEXELS, 3] (row 0 at v = 1)."""
    noise = Noise(rng)
    x, y = np.meshgrid(*2 * [_spread(np.linspace(-1, 1, ROWS))], indexing="xy")
    z = ground_height(settings, x, y, rock, noise)
    u, v = np.meshgrid(*2 * [np.linspace(0, 1, ROWS)], indexing="xy")
    i, j = np.meshgrid(*2 * [np.arange(ROWS - 1)], indexing="xy")
    a = (j * ROWS + i).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + ROWS], 1), np.stack([a + 1, a + ROWS + 1, a + ROWS], 1)])
    visual = trimesh.visual.TextureVisuals(uv=np.stack([u, v], -1).reshape(-1, 2))
    mesh = trimesh.Trimesh(np.stack([x, y, z], -1).reshape(-1, 3), faces, visual=visual, process=False)

    centre = _spread((np.arange(TEXELS) + 0.5) / TEXELS * 2 - 1)
    tx, ty = np.meshgrid(centre, -centre, indexing="xy")
    p = np.stack([tx, ty, np.zeros_like(tx)], -1).astype(np.float32)
    tone = 1 + 0.10 * noise.fractal(p, 1.5, 4, 0.7) + 0.13 * noise.fractal(p, 0.05, 3, 1.0)
    tone -= 0.35 * np.clip(noise.octave(p, 0.03) - 1.6, 0, 1)
    tint = 1 + 0.04 * noise.fractal(p, 4.0, 3)[..., None] * np.array([1, 0, -1], np.float32)
    return mesh, np.clip(np.asarray(settings.colour, np.float32) * tone[..., None] * tint, 0.01, 0.9)


def ground_height(settings: Arena, x: np.ndarray, y: np.ndarray, rock: trimesh.Trimesh, noise: Noise) -> np.ndarray:
    """Height of the terrain, metres: swells that grow with distance, ripples and grain, and an apron around the rock."""
    p = np.stack([x, y, np.zeros_like(x)], -1).astype(np.float32)
    far = np.hypot(x, y)
    foot = np.abs(rock.vertices[np.abs(rock.vertices[:, 2]) < 0.1 * rock.extents[2]][:, :2])
    radius = np.linalg.norm(foot, axis=1).mean() if len(foot) else 0.5 * rock.extents[:2].mean()
    swell = settings.undulation * noise.fractal(p, 2.5, 4, 0.45) * (1 + (far / 9) ** 1.5)
    ripples = 0.004 * noise.fractal(p, 0.16, 2, 0.6)
    apron = 0.05 * np.exp(-(((far - radius) / (0.35 * radius)) ** 2))
    return swell + ripples + apron


def make_stones(
    settings: Arena, rock: trimesh.Trimesh, ground: trimesh.Trimesh, rng: np.random.Generator
) -> trimesh.Trimesh | None:
    """Small stones scattered over the ground as one mesh with vertex colours (linear RGB, float), or None for no stones."""
    if not settings.stones:
        return None
    templates = []
    for _ in range(6):
        radii = (1.0, rng.uniform(0.6, 0.9), rng.uniform(0.4, 0.7))
        shape = Rock(size=1.0, lobes=(Lobe(radii=radii),), detail=0.07, buried=0.25, cracks=0)
        stone = make_rock(shape, rng)
        stone.merge_vertices(merge_tex=True, merge_norm=True)
        templates.append(stone)
    keep_out = settings.clearance * np.linalg.norm(rock.vertices[rock.vertices[:, 2] > 0][:, :2], axis=1).max()
    # Density falls with distance as the terrain's vertices do; sizes follow the power law of fragmented rock.
    at = _spread(rng.uniform(-0.8, 0.8, (4 * settings.stones, 2)))
    at = at[np.linalg.norm(at, axis=1) > keep_out][: settings.stones]
    sizes = np.minimum(0.6 * settings.stone_size * rng.uniform(0, 1, len(at)) ** (-1 / 1.8), settings.largest_stone)
    z = _height_at(ground, at)
    vertices, faces, colours, offset = [], [], [], 0
    for (x, y), height, size in zip(at, z, sizes, strict=True):
        stone = templates[rng.integers(len(templates))]
        turn = rng.uniform(0, 2 * np.pi)
        c, s = np.cos(turn), np.sin(turn)
        turned = stone.vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        vertices.append(turned * size + [x, y, height])
        faces.append(stone.faces + offset)
        tone = np.asarray(settings.colour, np.float32) * rng.uniform(0.45, 1.1)
        colours.append(np.broadcast_to(tone + (tone.mean() - tone) * rng.uniform(0, 0.7), (len(turned), 3)))
        offset += len(turned)
    mesh = trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)
    mesh.vertex_attributes["color"] = np.concatenate(colours).astype(np.float32)
    return mesh


def _spread(u: np.ndarray) -> np.ndarray:
    """[-1,1] -> [-REACH, REACH], dense at the middle (hyperbolic sine)."""
    return REACH * np.sinh(5.5 * u) / np.sinh(5.5)


def _height_at(ground: trimesh.Trimesh, at: np.ndarray) -> np.ndarray:
    """Terrain height at points [N,2], bilinear in the terrain's own grid."""
    u = (np.arcsinh(at / REACH * np.sinh(5.5)) / 5.5 + 1) / 2 * (ROWS - 1)
    z = ground.vertices[:, 2].reshape(ROWS, ROWS)
    i = np.clip(u.astype(int), 0, ROWS - 2)
    f = u - i
    (ix, iy), (fx, fy) = i.T, f.T
    low = z[iy, ix] * (1 - fx) + z[iy, ix + 1] * fx
    return low * (1 - fy) + (z[iy + 1, ix] * (1 - fx) + z[iy + 1, ix + 1] * fx) * fy
