"""The Mitsuba scene: rock, ground, sun and sky, loaded once, and one camera that moves. The variant
must be set before this module is imported (`mgs.runtime.start`)."""

from dataclasses import dataclass
from math import isqrt
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from mgs.camera import Camera
from mgs.colour import linear_from_srgb
from mgs.data.frames import boundary
from mgs.images import around
from mgs.memory import padded
from mgs.seeds import generator
from mgs.synth.arena import make_ground, make_stones, regolith
from mgs.synth.scene_file import Rock, SceneFile, Sky

MAX_DEPTH = 4  # longest light path in Mitsuba's count: direct light and two bounces
# Guides (albedo, normals) are cheap; with so many they count as clean, and their texture stays.
GUIDES_PER_SAMPLE = 4  # samples of the denoiser's guides per sample of light
# As good as "high" with 2 guides per sample, in 5/6 of the CPU time.
DENOISER = "balanced"  # quality of Open Image Denoise
MARGIN = 16  # pixels around the rock's bounding box that the denoiser of the rock alone sees too
COVERAGE_RAYS = 255  # of a pixel: 255 shares are exact in 8 bits; odd, for one through the centre
_MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])  # x to the left, y up, z forward


@dataclass(frozen=True)
class Rendered:
    """One frame, linear radiance before exposure. Depth and mask are taken along the rays through
    the pixel centres."""

    rgb: np.ndarray  # [H,W,3], mean over the pixel
    rock: np.ndarray  # [H,W,4], the rock alone, premultiplied by alpha, its share of the pixel
    depth: np.ndarray  # [H,W] z-depth, metres, 0 = sky
    mask: np.ndarray  # bool [H,W]


Layers = tuple[np.ndarray, np.ndarray, np.ndarray]  # result of `mgs.synth.rock_layer.render_layers`


@dataclass(frozen=True)
class Traced:
    """One frame before it is denoised."""

    light: Layers  # RGB
    guides: Layers | None  # RGB (unused), albedo, normal; None if nothing is to be denoised
    alpha: np.ndarray  # float32 [H,W], share of the pixel that the rock covers
    depth: np.ndarray  # as in `Rendered`
    mask: np.ndarray

    def developed(self) -> Rendered:
        """Denoise and compose, without Dr.Jit, so that another frame may be traced meanwhile."""
        from mgs.synth.rock_layer import continued, with_coverage

        rgb, rock, share = self.light
        alpha = self.alpha
        rock = with_coverage(rock, share, alpha)
        if self.guides is not None:
            guides, rock_guides, share = self.guides
            rgb = _denoise(rgb, guides)
            if alpha.any():
                box = around(alpha > 0, MARGIN)  # black pixels would cost as much as others
                noisy = continued(rock[box], alpha[box])
                rock_guides = with_coverage(rock_guides, share, alpha)
                clean = _denoise(noisy, continued(rock_guides[box], alpha[box]))
                rock[box] = np.maximum(rock[box] + clean - noisy, 0)
        inside, outside = alpha[..., None] == 1, alpha[..., None] == 0
        rock = np.where(inside, rgb, np.where(outside, 0, rock))
        return Rendered(rgb, np.dstack([rock, alpha]), self.depth, self.mask)


class MitsubaScene:
    """A rock on its arena under sun and sky. All cameras have one size and K."""

    def __init__(
        self, settings: SceneFile, rock: trimesh.Trimesh, camera: Camera, seed: int
    ) -> None:
        from mgs.synth.rock_layer import Guides, RockLayer  # needs the variant that is set by now

        ground = make_ground(settings.arena, rock, generator(seed, "ground"))
        stones = make_stones(settings.arena, rock, ground, generator(seed, "stones"))
        shapes = {"rock": _mesh("rock", rock, _rock_bsdf(rock, settings.rock))}
        tiles = regolith(settings.arena, generator(seed, "regolith"))
        drift, lag = ({"type": "diffuse", "reflectance": _bitmap(tile)} for tile in tiles)
        weight = {"type": "mesh_attribute", "name": "vertex_blend"}
        shapes["ground"] = _mesh(
            "ground", ground, {"type": "blendbsdf", "weight": weight, "drift": drift, "lag": lag}
        )
        if stones is not None:
            colour = {"type": "mesh_attribute", "name": "vertex_color"}
            shapes["stones"] = _mesh("stones", stones, {"type": "diffuse", "reflectance": colour})
        self.scene = mi.load_dict(
            {"type": "scene", "sky": _sunsky(settings.sky), "sensor": sensor_dict(camera), **shapes}
        )
        self.params = mi.traverse(self.scene)
        self.params.keep(["sensor.to_world"])
        self.rock = next(shape for shape in self.scene.shapes() if shape.id() == "rock")
        self.path = RockLayer(mi.load_dict({"type": "path", "max_depth": MAX_DEPTH}), self.rock)
        self.guides = Guides(self.rock)

    def render(self, camera: Camera, spp: int, seed: int, denoise: bool) -> Rendered:
        """Path-trace one frame with `spp` samples per pixel; denoise: by Open Image Denoise.

        Pixels that the rock covers wholly are the same in the image and in the picture of the rock
        alone. At the outline the latter is denoised on its own, guided by albedo and normals of the
        rock alone."""
        return self.trace(camera, spp, seed, denoise).developed()

    def trace(self, camera: Camera, spp: int, seed: int, denoise: bool) -> Traced:
        """The part of `render` that Mitsuba computes."""
        from mgs.synth.rock_layer import render_layers

        light = self.light(camera, spp, seed)
        depth, mask = self.cast(camera)
        alpha = self.coverage(camera, mask, light[2])
        guides = None
        if denoise:
            samples = whole_grid(GUIDES_PER_SAMPLE * spp)
            guides = render_layers(self.scene, self.guides, samples, seed)
        return Traced(light, guides, alpha, depth, mask)

    def light(self, camera: Camera, spp: int, seed: int) -> Layers:
        """Path-trace one frame and nothing else; the camera stays."""
        from mgs.synth.rock_layer import render_layers

        self.params["sensor.to_world"] = mi.Transform4f(_to_world(camera))
        self.params.update()
        return render_layers(self.scene, self.path, spp, seed)

    def cast(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """z-depth, float32 [H,W], metres, 0 = sky, and rock mask, bool, at pixel centres."""
        rays = camera.unproject(np.ones((camera.height, camera.width))) - camera.position
        size = (camera.height, camera.width)
        z, mask = self._first_hits(camera, rays.reshape(-1, 3))
        return z.reshape(size), mask.reshape(size)

    def coverage(self, camera: Camera, mask: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Share of each pixel's area that the rock covers, float32 [H,W]. mask: bool [H,W], rock at
        the pixel's centre. share: [H,W], share of a few random rays that meet the rock.
        COVERAGE_RAYS rays are cast through pixels at the outline of the mask and where mask and
        share differ; elsewhere the coverage is the mask."""
        from mgs.synth.rock_layer import lattice

        alpha = mask.astype(np.float32)
        rows, columns = np.nonzero(boundary(mask) | (share != mask))
        if not len(rows):
            return alpha
        offsets, K = lattice(COVERAGE_RAYS).T, camera.K
        u, v = columns[:, None] + offsets[0], rows[:, None] + offsets[1]
        local = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
        rays = local.reshape(-1, 3) @ camera.world_to_camera[:3, :3]
        on_rock = self._first_hits(camera, rays)[1].reshape(len(rows), -1)
        # The ray through the centre, so that coverage and mask never contradict.
        on_rock[:, COVERAGE_RAYS // 2] = mask[rows, columns]
        alpha[rows, columns] = on_rock.mean(1)
        return alpha

    def _first_hits(self, camera: Camera, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First hits of rays [N,3], world axes, of z-depth 1: their z-depth, float32 [N], metres, 0
        = sky, and whether they are the rock, bool [N]."""
        length = np.linalg.norm(rays, axis=1)
        origin = mi.Point3f(*camera.position.tolist())
        unit = (rays / length[:, None]).T
        directions = mi.Vector3f(*(mi.Float(padded(column)) for column in unit))
        dr.make_opaque(origin)  # a literal would compile a new kernel for every camera
        hit = self.scene.ray_intersect_preliminary(mi.Ray3f(origin, directions), coherent=True)
        dr.eval(hit)  # otherwise each array read below would trace the rays again
        z = np.where(hit.is_valid().numpy(), hit.t.numpy() / length, 0)
        return z.astype(np.float32), (hit.shape == mi.ShapePtr(self.rock)).numpy()


def _denoise(rgb: np.ndarray, guides: np.ndarray) -> np.ndarray:
    """Denoise rgb [H,W,3]. guides [H,W,9]: RGB (unused), albedo, normal."""
    import pyoidn

    albedo, normal = np.clip(guides[..., 3:6], 0, 1), np.clip(guides[..., 6:], -1, 1)
    rgb = np.ascontiguousarray(rgb)
    return pyoidn.denoise(
        rgb, albedo=albedo, normal=normal, hdr=True, clean_aux=True, quality=DENOISER
    )


def whole_grid(spp: int) -> int:
    """Round samples per pixel up to a full grid of about as many rows as columns, as Mitsuba's
    `multijitter` does."""
    columns = isqrt(spp)
    return columns * -(-spp // columns)


def sensor_dict(camera: Camera) -> dict[str, Any]:
    """Mitsuba perspective sensor of a camera; a pixel is the mean over its area. Samples are
    correlated multi-jittered: with 16, frames are 3 dB nearer to the truth than with independent
    ones (docs/data.md)."""
    K, w, h = camera.K, camera.width, camera.height
    film = {"type": "hdrfilm", "width": w, "height": h, "pixel_format": "rgb"}
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(w / 2 / K[0, 0]))),
        "fov_axis": "x",
        "principal_point_offset_x": float(0.5 - K[0, 2] / w),
        "principal_point_offset_y": float(0.5 - K[1, 2] / h),
        "near_clip": 0.01,
        "to_world": mi.ScalarTransform4f(_to_world(camera)),
        "film": film | {"rfilter": {"type": "box"}},
        "sampler": {"type": "multijitter"},
    }


def _to_world(camera: Camera) -> np.ndarray:
    return camera.camera_to_world @ _MITSUBA_FROM_OPENCV


def _sunsky(sky: Sky) -> dict[str, Any]:
    elevation, azimuth = np.radians([sky.sun_elevation, sky.sun_azimuth])
    flat = np.cos(elevation)
    sun = [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)]
    return {
        "type": "sunsky",
        "sun_direction": [float(x) for x in sun],
        "turbidity": sky.turbidity,
        "sun_scale": sky.sun_scale,
        "sky_scale": sky.sky_scale,
    }


def _bitmap(linear: np.ndarray) -> dict[str, Any]:
    return {"type": "bitmap", "data": mi.TensorXf(padded(linear)), "raw": True}


def _rock_bsdf(rock: trimesh.Trimesh, settings: Rock) -> dict[str, Any]:
    """Material of the rock, by its texture, else vertex colours, else the light mineral."""
    visual: Any = rock.visual
    material = getattr(visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is not None and visual.uv is not None:
        colour = _bitmap(linear_from_srgb(np.asarray(image.convert("RGB"), np.float32) / 255))
    elif visual.kind == "vertex":
        rgb = linear_from_srgb(visual.vertex_colors[:, :3].astype(np.float32) / 255)
        rock.vertex_attributes["color"] = rgb
        colour = {"type": "mesh_attribute", "name": "vertex_color"}
    else:
        colour = {"type": "rgb", "value": list(settings.colours[0])}
    return {
        "type": "principled",
        "base_color": colour,
        "roughness": settings.roughness,
        "specular": settings.specular,
    }


def _mesh(name: str, mesh: trimesh.Trimesh, bsdf: dict[str, Any]) -> Any:
    uv = getattr(mesh.visual, "uv", None)
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "material": bsdf})
    shape = mi.Mesh(
        name,
        len(mesh.vertices),
        len(mesh.faces),
        has_vertex_normals=True,
        has_vertex_texcoords=uv is not None,
        props=properties,
    )
    for attribute, values in mesh.vertex_attributes.items():
        flat: Any = np.ravel(values)
        shape.add_attribute(f"vertex_{attribute}", np.shape(values)[1], flat)
    params = mi.traverse(shape)
    params["vertex_positions"] = mi.Float(padded(mesh.vertices).ravel())
    params["vertex_normals"] = mi.Float(padded(mesh.vertex_normals).ravel())
    params["faces"] = mi.UInt32(padded(mesh.faces, np.uint32).ravel())
    if uv is not None:
        params["vertex_texcoords"] = mi.Float(padded(np.stack([uv[:, 0], 1 - uv[:, 1]], 1)).ravel())
    params.update()
    dr.eval(params["vertex_positions"])
    return shape
