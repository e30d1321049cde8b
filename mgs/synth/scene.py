"""The Mitsuba scene: rock, ground, sun and sky, and one camera that moves. It is loaded once; only the sensor changes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from mgs.camera import Camera
from mgs.colour import linear_from_srgb
from mgs.seeds import generator
from mgs.synth.arena import make_ground, make_stones, regolith
from mgs.synth.scene_file import SceneFile, Sky

MAX_DEPTH = 4
"""Path length: direct light and two bounces; light between rock and ground matters in the shade."""

GUIDES_PER_SAMPLE = 2
"""Samples of the denoiser's guides for each sample of light. Guides are cheap and, nearly free of noise, can be declared clean:
the denoiser then keeps the texture they show."""

_MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Mitsuba's camera frame is x to the image's left, y up, z forward."""


@dataclass(frozen=True)
class Rendered:
    """One frame. rgb [H,W,3] linear radiance, exposure not applied; depth [H,W] z-depth, metres, 0 = sky; mask [H,W] bool.

    Depth and mask are taken along the rays through the pixel centres; rgb is averaged over the pixel.
    """

    rgb: np.ndarray
    depth: np.ndarray
    mask: np.ndarray


class Scene:
    """A rock on its arena under sun and sky, seen through cameras of one size and one K."""

    def __init__(self, settings: SceneFile, rock: trimesh.Trimesh, camera: Camera, seed: int) -> None:
        ground = make_ground(settings.arena, rock, generator(seed, "ground"))
        stones = make_stones(settings.arena, rock, ground, generator(seed, "stones"))
        shapes = {"rock": _mesh("rock", rock, _rock_bsdf(rock, settings.rock.colours[0]))}
        tiles = regolith(settings.arena, generator(seed, "regolith"))
        drift, lag = ({"type": "diffuse", "reflectance": _bitmap(tile)} for tile in tiles)
        weight = {"type": "mesh_attribute", "name": "vertex_blend"}
        shapes["ground"] = _mesh("ground", ground, {"type": "blendbsdf", "weight": weight, "drift": drift, "lag": lag})
        if stones is not None:
            colour = {"type": "mesh_attribute", "name": "vertex_color"}
            shapes["stones"] = _mesh("stones", stones, {"type": "diffuse", "reflectance": colour})
        path = {"type": "path", "max_depth": MAX_DEPTH}
        self.guides = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
        self.scene = mi.load_dict(
            {"type": "scene", "integrator": path, "sky": _sunsky(settings.sky), "sensor": sensor_dict(camera), **shapes}
        )
        self.params = mi.traverse(self.scene)
        self.params.keep(["sensor.to_world"])
        self.rock = next(shape for shape in self.scene.shapes() if shape.id() == "rock")

    def render(self, camera: Camera, spp: int, seed: int, denoise: bool) -> Rendered:
        """Path-trace one frame with `spp` samples per pixel; with `denoise`, Open Image Denoise guided by albedo and normal."""
        self.params["sensor.to_world"] = mi.Transform4f(_to_world(camera))
        self.params.update()
        rgb = np.array(mi.render(self.scene, spp=spp, seed=seed))
        if denoise:
            import pyoidn

            guides = np.array(mi.render(self.scene, integrator=self.guides, spp=GUIDES_PER_SAMPLE * spp, seed=seed))
            albedo, normal = np.clip(guides[..., :3], 0, 1), np.clip(guides[..., 3:], -1, 1)
            rgb = pyoidn.denoise(rgb, albedo=albedo, normal=normal, hdr=True, clean_aux=True)
        depth, mask = self.cast(camera)
        return Rendered(rgb, depth, mask)

    def cast(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """z-depth [H,W] (metres, 0 = sky) and rock mask [H,W] along the rays through the pixel centres."""
        origin = camera.position
        rays = (camera.unproject(np.ones((camera.height, camera.width))) - origin).reshape(-1, 3)
        length = np.linalg.norm(rays, axis=1)
        directions = mi.Vector3f((rays / length[:, None]).T.astype(np.float32))
        hit = self.scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(*origin.tolist()), directions))
        z = np.where(hit.is_valid().numpy(), hit.t.numpy() / length, 0)
        mask = (hit.shape == mi.ShapePtr(self.rock)).numpy()
        size = (camera.height, camera.width)
        return z.reshape(size).astype(np.float32), mask.reshape(size)


def sensor_dict(camera: Camera) -> dict[str, Any]:
    """A Mitsuba perspective sensor that is `camera`, with a box filter (sharp pixels, independent of their neighbours)."""
    K, w, h = camera.K, camera.width, camera.height
    film = {"type": "hdrfilm", "width": w, "height": h, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(w / 2 / K[0, 0]))),
        "fov_axis": "x",
        "principal_point_offset_x": float(0.5 - K[0, 2] / w),
        "principal_point_offset_y": float(0.5 - K[1, 2] / h),
        "near_clip": 0.01,
        "to_world": mi.ScalarTransform4f(_to_world(camera)),
        "film": film,
        "sampler": {"type": "independent"},
    }


def _to_world(camera: Camera) -> np.ndarray:
    return camera.camera_to_world @ _MITSUBA_FROM_OPENCV


def _sunsky(sky: Sky) -> dict[str, Any]:
    elevation, azimuth = np.radians([sky.sun_elevation, sky.sun_azimuth])
    sun = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    scales = {"sun_scale": sky.sun_scale, "sky_scale": sky.sky_scale}
    return {"type": "sunsky", "sun_direction": [float(x) for x in sun], "turbidity": sky.turbidity, **scales}


def _bitmap(linear: np.ndarray) -> dict[str, Any]:
    return {"type": "bitmap", "data": mi.TensorXf(np.ascontiguousarray(linear, np.float32)), "raw": True}


def _rock_bsdf(rock: trimesh.Trimesh, plain: tuple[float, float, float]) -> dict[str, Any]:
    """A rough dielectric-coated diffuser that keeps the mesh's texture, else its vertex colours, else one `plain` colour."""
    visual: Any = rock.visual
    image = getattr(visual, "material", None) and _texture_image(visual.material)
    if image is not None and visual.uv is not None:
        colour = _bitmap(linear_from_srgb(np.asarray(image.convert("RGB"), np.float32) / 255))
    elif visual.kind == "vertex":
        rgb = linear_from_srgb(visual.vertex_colors[:, :3].astype(np.float32) / 255)
        rock.vertex_attributes["color"] = rgb
        colour = {"type": "mesh_attribute", "name": "vertex_color"}
    else:
        colour = {"type": "rgb", "value": list(plain)}
    return {"type": "principled", "base_color": colour, "roughness": 0.8, "specular": 0.3}


def _texture_image(material: Any) -> Any:
    """The base-colour image of a trimesh material (PBR or simple), or None."""
    return getattr(material, "baseColorTexture", None) or getattr(material, "image", None)


def _mesh(name: str, mesh: trimesh.Trimesh, bsdf: dict[str, Any]) -> Any:
    """trimesh -> mi.Mesh with normals, UVs (v turned to Mitsuba's, downwards) and vertex attributes."""
    uv = getattr(mesh.visual, "uv", None)
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "material": bsdf})
    shape = mi.Mesh(name, len(mesh.vertices), len(mesh.faces), has_vertex_normals=True, has_vertex_texcoords=uv is not None,
                    props=properties)  # fmt: skip
    for attribute, values in mesh.vertex_attributes.items():
        flat: Any = np.ravel(values)
        shape.add_attribute(f"vertex_{attribute}", np.shape(values)[1], flat)
    params = mi.traverse(shape)
    params["vertex_positions"] = mi.Float(mesh.vertices.astype(np.float32).ravel())
    params["vertex_normals"] = mi.Float(mesh.vertex_normals.astype(np.float32).ravel())
    params["faces"] = mi.UInt32(mesh.faces.astype(np.uint32).ravel())
    if uv is not None:
        params["vertex_texcoords"] = mi.Float(np.stack([uv[:, 0], 1 - uv[:, 1]], 1).astype(np.float32).ravel())
    params.update()
    dr.eval(params["vertex_positions"])
    return shape
