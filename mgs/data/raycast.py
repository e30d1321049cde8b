"""Depth images of a mesh, by rays through the pixel centres."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs import runtime
from mgs.camera import Camera
from mgs.memory import padded

if TYPE_CHECKING:
    from mgs.data.meshes import Mesh


def mesh_depth(mesh: Mesh) -> Callable[[Camera], np.ndarray]:
    """Return depth(camera): z-depth of the mesh, float32 [H,W], metres, 0 where no face is hit.

    One ray through each pixel centre, which meets faces from either side. Raises InputError if no
    variant can be started (`mgs.runtime.start`).
    """
    runtime.start()
    centre = mesh.vertices.mean(0)  # rays are cast around it: float32 is finest near the origin
    shape = mi.Mesh("mesh", len(mesh.vertices), len(mesh.faces))
    params = mi.traverse(shape)
    params["vertex_positions"] = mi.Float(padded(mesh.vertices - centre).ravel())
    params["faces"] = mi.UInt32(padded(mesh.faces, np.uint32).ravel())
    params.update()
    scene = mi.load_dict({"type": "scene", "mesh": shape})

    def depth(camera: Camera) -> np.ndarray:
        rays = mi.Matrix3f(camera.camera_to_world[:3, :3] @ np.linalg.inv(camera.K))
        origin = mi.Point3f(*(camera.position - centre).tolist())
        dr.make_opaque(rays, origin)  # literals would compile a new kernel for every camera
        pixel = dr.arange(mi.UInt32, camera.width * camera.height)
        row = pixel // camera.width
        column = pixel - row * camera.width
        # Directions have z-depth 1, so t is z-depth.
        direction = rays @ mi.Vector3f(mi.Float(column) + 0.5, mi.Float(row) + 0.5, 1)
        hit = scene.ray_intersect_preliminary(mi.Ray3f(origin, direction))
        return dr.select(hit.is_valid(), hit.t, 0).numpy().reshape(camera.height, camera.width)

    return depth
