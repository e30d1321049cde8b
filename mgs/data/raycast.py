"""Depth images of a mesh, by rays through the pixel centres."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs import runtime
from mgs.camera import Camera
from mgs.data.clouds import towards
from mgs.data.lens import shrunk_to
from mgs.data.meshes import Mesh
from mgs.data.world import World
from mgs.errors import InputError
from mgs.memory import padded

SMALL = 40_000  # pixels of a picture in which a mesh is searched


def mesh_in_sight(mesh: Mesh, cameras: Sequence[Camera], world: World, where: object) -> Mesh:
    """Move a mesh to a dataset of this world (`towards`, `World.enter`), and check that it is in
    some picture. where: begins a message. Raises InputError if none of a few cameras sees the mesh,
    or all are inside, as happens with another unit or other axes."""
    mesh = replace(mesh, vertices=world.enter(towards(mesh.vertices, world.origin)))
    depth, some = mesh_depth(mesh), cameras[:: max(1, len(cameras) // 4)]
    hits = [depth(shrunk_to(camera, SMALL)[0]) > 0 for camera in some]
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    within = all(((low < camera.position) & (camera.position < high)).all() for camera in some)
    if any(hit.any() for hit in hits) and not (within and all(hit.all() for hit in hits)):
        return mesh
    size = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    near = min(float(np.linalg.norm(camera.position - mesh.vertices.mean(0))) for camera in some)
    raise InputError(
        f"{where}: the mesh is in no picture, or around all cameras: it is {size:.3g} across, and "
        f"the nearest camera is {near:.3g} from its middle; give it in the cameras' unit and axes"
    )


def mesh_depth(mesh: Mesh) -> Callable[[Camera], np.ndarray]:
    """Return depth(camera): z-depth of the mesh, float32 [H,W], metres, 0 where no face is hit. One
    ray through each pixel centre, which meets faces from either side. Raises InputError if no
    variant can be started (`mgs.runtime.start`)."""
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
