"""The viewer: a local web server (viser). Its threads only record requests; all is computed in
`Viewer.tick`, on the thread that made the viewer, because Mitsuba's variant belongs to a thread."""

import math
import time
import warnings
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.colour import srgb_from_linear
from mgs.errors import InputError
from mgs.reports.page_plots import FRUSTUM
from mgs.view import layers
from mgs.view.access import Access, bound_socket, plain
from mgs.view.layers import View, read_subject

REST = 0.2  # seconds without movement after which a camera counts as resting
FOLLOW = 1.0  # seconds between two checks of the run folder
PIXELS = 1e6  # most pixels of an image of the kernel; a larger window shows it enlarged
LARGEST_NUMBER = 1e6  # bound of every number that a browser window sends
PREVIEW = 480  # width of the image that a click on a camera shows, pixels

COLOURS = {"seed": (213, 94, 0), "chosen": (0, 158, 115), "candidate": (130, 130, 130)}
"""Colours of cameras by role, sRGB."""

SELECTED = (255, 220, 60)  # colour of the camera that was clicked
THIN: dict[str, Any] = {"thickness": 1.5, "thickness_units": "screen"}  # pixels
FILLED = 0.35  # share of the window's height that the object fills at first
BLACK = np.zeros((2, 2, 3), np.uint8)  # background without an image of the kernel


@dataclass
class _Client:
    """A browser window. splats: its copy of the Gaussians. moved: time of its camera's last move.
    drawn: (moved, version) of the last drawing. covered: whether the kernel's image is shown."""

    handle: Any
    splats: Any
    moved: float
    drawn: tuple[float, int] | None = None
    layer: str = ""
    covered: bool = False


class Viewer:
    """Serve a run folder or a PLY until `close`. `tick` must be called repeatedly.

    follow: look for a new step of the run every FOLLOW seconds. Raises InputError as `read_subject`
    and `bound_socket`."""

    def __init__(
        self, path: str | Path, host: str = "127.0.0.1", port: int = 8080, follow: bool = False
    ) -> None:
        self.path, self.follow = Path(path), follow
        self.stamp = self._stamp()
        self.subject = read_subject(path, follow)
        import viser

        # A window may be closed while its image is drawn; viser then warns.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        self.access, listening = Access(host), bound_socket(host, port)
        self.port = listening.getsockname()[1]
        with redirect_stdout(StringIO()), self.access.guarding(listening):  # viser greets
            self.server = viser.ViserServer(host, self.port, label="mgs", verbose=False)
        self.clients: dict[int, _Client] = {}
        self.frusta: dict[str, Any] = {}
        self.selected = ""
        self.version = 0
        self.next_look = time.monotonic() + FOLLOW
        self._scene()
        self._controls()
        self._show_views()
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._disconnected)

    def close(self) -> None:
        with redirect_stdout(StringIO()):
            self.server.stop()

    def tick(self) -> None:
        """Read a new step, and draw for the cameras that rest."""
        now = time.monotonic()
        if self.follow and now >= self.next_look:
            self.next_look, stamp = now + FOLLOW, self._stamp()
            if stamp != self.stamp:
                self.stamp, self.subject = stamp, read_subject(self.path, self.follow)
                self._renew()
        for client in list(self.clients.values()):
            state = client.moved, self.version
            due = client.drawn != state and now >= client.moved + REST
            if due and self.subject.gaussians is not None:
                try:
                    self._draw(client)
                except Exception:  # whatever a window sent, the others go on
                    client.drawn = state  # but not what it asked for meanwhile

    def _stamp(self) -> list[int]:
        files = [self.path / name for name in ("checkpoint.npz", "metrics.json")]
        return [file.stat().st_mtime_ns if file.is_file() else 0 for file in files]

    def _scene(self) -> None:
        scene, subject, first = self.server.scene, self.subject, self.server.initial_camera
        self.server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        scene.set_up_direction((0.0, 0.0, 1.0))
        scene.configure_environment_map(None)
        scene.world_axes.visible = False
        scene.set_background_image(BLACK)
        centre, size = subject.extent
        direction = np.array([1.0, -1.0, 0.8])
        if subject.views:  # from above, so that no camera is before the object
            offset = subject.eyes[0] - centre
            direction = offset + np.linalg.norm(offset) * np.array([0.0, 0.0, 1.0])
            first.fov = _vertical_fov(subject.views[0].frame.camera)
        direction /= max(float(np.linalg.norm(direction)), 1e-9)
        first.look_at = centre
        first.position = centre + size / (FILLED * np.tan(first.fov / 2)) * direction
        if subject.of_scene:  # there is no outside: begin where a picture was taken
            camera = subject.taken[0].frame.camera
            first.position = camera.position
            first.look_at = camera.position + camera.world_to_camera[2, :3]
        if (mesh := subject.mesh) is not None:
            vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)
            look: dict[str, Any] = {"color": (150, 160, 175), "visible": False}
            self.mesh = scene.add_mesh_simple("/mesh", vertices, faces, **look)

    def _controls(self) -> None:
        gui, names = self.server.gui, layers.layers(self.subject)
        self.title = gui.add_markdown("")
        hint = "What is drawn: by the kernel, and by the browser"
        self.layer: Any = gui.add_dropdown("Layer", names, hint=hint)
        self.legend = gui.add_markdown("")
        hint = "The kernel's own image while the camera rests"
        self.exact = gui.add_checkbox("Exact at rest", True, hint=hint)
        self.gaussians = gui.add_checkbox("Gaussians", True)
        for control in (self.layer, self.exact, self.gaussians):
            control.on_update(lambda _: self._again())
        if self.subject.mesh is not None:
            self._switch("Mesh of the prior", False, self.mesh)
        if not self.subject.views:
            return
        group = self.server.scene.add_frame("/cameras", show_axes=False)
        self._switch("Cameras", True, group, "Orange: seeds; green: chosen; grey: candidates")
        names = [view.frame.name for view in self.subject.views]
        self.view: Any = gui.add_dropdown("View", names, hint="Or click a camera")
        self.view.on_update(lambda _: self.select(self.view.value))
        gui.add_button("Look from there").on_click(lambda event: self._look(event.client))
        self.facts = gui.add_markdown("Click a camera to see its image.")
        self.image = gui.add_image(np.zeros((3, 4, 3), np.uint8), format="jpeg", visible=False)

    def _switch(self, label: str, on: bool, shown: Any, hint: str | None = None) -> None:
        box = self.server.gui.add_checkbox(label, on, hint=hint)
        box.on_update(lambda _: setattr(shown, "visible", box.value))

    def _again(self) -> None:
        self.version += 1

    def _renew(self) -> None:
        for client in list(self.clients.values()):
            splats, client.splats = client.splats, None
            if splats is not None:
                splats.remove()
        chosen = self.layer.value
        self.layer.options = layers.layers(self.subject)
        self.layer.value = chosen
        self._show_views()
        self._again()

    def _show_views(self) -> None:
        subject, scene = self.subject, self.server.scene
        self.title.content = f"**{plain(subject.title)}**"
        if not subject.views:
            return
        size = FRUSTUM * float(np.linalg.norm(subject.eyes - subject.extent[0], axis=1).mean())
        for view in subject.views:
            self._show_camera(view, size)
        way = [view.frame.camera.position for view in subject.taken if view.role == "chosen"]
        if len(way) > 1:
            segments = np.stack([way[:-1], way[1:]], axis=1).astype(np.float32)
            scene.add_line_segments("/cameras/way", segments, colors=COLOURS["chosen"], **THIN)

    def _show_camera(self, view: View, size: float) -> None:
        camera, name = view.frame.camera, view.frame.name
        wxyz, position = _pose(camera)
        self.frusta[name] = self.server.scene.add_camera_frustum(
            f"/cameras/views/{name}",
            _vertical_fov(camera),
            camera.width / camera.height,
            scale=(0.2 if view.role == "candidate" else 0.4) * size,
            color=SELECTED if name == self.selected else COLOURS[view.role],
            wxyz=wxyz,
            position=position,
            **THIN,
        )
        self.frusta[name].on_click(lambda _: self._clicked(name))
        if view.role == "chosen":
            self.server.scene.add_label(f"/cameras/views/{name}/step", str(view.step))

    def _clicked(self, name: str) -> None:
        if self.view.value == name:
            self.select(name)
        else:
            self.view.value = name  # which selects it

    def select(self, name: str) -> None:
        """Show the facts and the image of a view, or the error if the image cannot be read."""
        by_name = {view.frame.name: view for view in self.subject.views}
        if name not in by_name:  # no window of ours sends it
            return
        if self.selected:
            self.frusta[self.selected].color = COLOURS[by_name[self.selected].role]
        self.selected, view = name, by_name[name]
        self.frusta[name].color = SELECTED
        role = f"chosen at step {view.step}" if view.role == "chosen" else view.role
        facts = [f"- {plain(key)}: {plain(value)}" for key, value in view.facts]
        self.facts.content = "\n".join([f"**{plain(name)}**: {role}", "", *facts])
        try:
            image = np.round(srgb_from_linear(view.frame.rgb()) * 255).astype(np.uint8)
            every = max(1, image.shape[1] // PREVIEW)
            self.image.image = np.ascontiguousarray(image[::every, ::every])
            self.image.visible = True
        except InputError as error:
            self.image.visible = False
            self.facts.content += f"\n\n{plain(str(error))}"

    def _look(self, client: Any) -> None:
        if client is None:  # the window was closed meanwhile
            return
        if self.selected != self.view.value:
            self.select(self.view.value)
        camera = next(v for v in self.subject.views if v.frame.name == self.selected).frame.camera
        wxyz, eye = _pose(camera)
        away = float(np.linalg.norm(self.subject.extent[0] - eye))
        with client.atomic():
            client.camera.wxyz, client.camera.position = wxyz, eye
            client.camera.look_at = eye + away * camera.camera_to_world[:3, 2]
            client.camera.fov = _vertical_fov(camera)

    def _connected(self, handle: Any) -> None:
        client = self.clients[handle.client_id] = _Client(handle, None, time.monotonic())

        @handle.camera.on_update
        def _moved(_: Any) -> None:
            client.moved = time.monotonic()
            if client.covered:
                self._uncover(client)

    def _disconnected(self, handle: Any) -> None:
        self.clients.pop(handle.client_id, None)

    def _uncover(self, client: _Client) -> None:
        client.covered = False
        client.handle.scene.set_background_image(BLACK)
        if client.splats is not None:
            client.splats.visible = bool(self.gaussians.value)

    def _draw(self, client: _Client) -> None:
        state, subject, names = (client.moved, self.version), self.subject, self.layer.options
        layer = self.layer.value if self.layer.value in names else names[0]
        g = subject.model
        if client.splats is None or layer != client.layer:
            colours = layers.gaussian_colours(subject, layer) / 255
        if client.splats is None:
            splats = layers.covariances(g), colours, g.opacities[:, None]
            add = client.handle.scene.add_gaussian_splats
            client.splats = add("/gaussians", g.means, *splats, visible=False)
        elif layer != client.layer:
            client.splats.rgbs = colours
        client.layer = layer
        camera = window_camera(client.handle.camera)
        if self.exact.value and self.gaussians.value and camera is not None:
            image, depth, ends = layers.kernel_image(subject, camera, layer)
            self.legend.content = layers.legend(layer, ends, subject.unit)
            if state[0] == client.moved:
                client.splats.visible, client.covered = False, True
                client.handle.scene.set_background_image(image, format="png", depth=depth)
        else:
            ends = layers.scale(subject, layer)
            self.legend.content = layers.legend(layer, ends, subject.unit)
            if layer == "depth":
                self.legend.content = "Depth is drawn by the kernel, at rest."
            self._uncover(client)
        client.drawn = state


def window_camera(camera: Any) -> Camera | None:
    """Camera of a browser window (viser's CameraHandle), with at most PIXELS.

    None where what the window sent is no camera: a size, field of view or pose out of range."""
    from viser.transforms import SE3, SO3

    width, height, wxyz = camera.image_width, camera.image_height, np.asarray(camera.wxyz, float)
    numbers = [width, height, camera.fov, *wxyz, *np.asarray(camera.position, float)]
    if not np.isfinite(numbers).all() or np.abs(numbers).max() > LARGEST_NUMBER:
        return None
    if min(width, height) < 1 or not 0.01 < camera.fov < 3.1 or np.linalg.norm(wxyz) < 1e-3:
        return None
    shrink = min(1.0, math.sqrt(PIXELS / (width * height)))
    width, height = max(1, round(width * shrink)), max(1, round(height * shrink))
    focal = height / 2 / math.tan(camera.fov / 2)
    turn = SO3(wxyz / np.linalg.norm(wxyz))
    pose = SE3.from_rotation_and_translation(turn, np.asarray(camera.position, float))
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(K, width, height, pose.inverse().as_matrix().astype(np.float64))


def _pose(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Rotation of a camera as a quaternion (w, x, y, z), and its position."""
    from viser.transforms import SO3

    return SO3.from_matrix(camera.camera_to_world[:3, :3]).wxyz, camera.position


def _vertical_fov(camera: Camera) -> float:
    return 2 * math.atan(camera.height / 2 / camera.K[1, 1])
