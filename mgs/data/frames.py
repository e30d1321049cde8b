"""Frames of a dataset: cameras and image files, and what a live capture recorded of them. Images of
the rock alone have premultiplied alpha in memory (the rock in front of black) and straight alpha in
PNG files. Alpha is the share of a pixel's area that shows the rock, 0 to 1."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion

from mgs.camera import Camera
from mgs.colour import linear_from_pixels, srgb_from_linear
from mgs.data.world import UPRIGHT, World
from mgs.errors import InputError
from mgs.files import read_json
from mgs.images import image_size, read_depth, read_mask, read_png, read_rgba, write_png
from mgs.metrics import blur


def write_rock_image(path: str | Path, rgba: np.ndarray) -> None:
    """Write linear RGB and alpha, [H,W,4] premultiplied, as 8-bit sRGB PNG, straight alpha."""
    alpha = rgba[..., 3:]
    straight = rgba[..., :3] / np.where(alpha > 0, alpha, 1)
    rgba = np.dstack([srgb_from_linear(straight), np.clip(alpha, 0, 1)])
    write_png(path, np.round(rgba * 255).astype(np.uint8))


def premultiplied(pixels: np.ndarray) -> np.ndarray:
    """sRGB with straight alpha [H,W,4], uint8 or uint16 -> linear RGB premultiplied by alpha, and
    alpha, float32."""
    alpha = pixels[..., 3:].astype(np.float32) / np.iinfo(pixels.dtype).max
    colour = linear_from_pixels(pixels[..., :3]) * alpha
    return np.concatenate([colour, alpha], axis=-1, dtype=np.float32)


def boundary(mask: np.ndarray) -> np.ndarray:
    """Pixels on either side of a mask's outline, bool [H,W]: those that differ from one of their
    four neighbours. The edge of the image is no outline."""
    return binary_dilation(mask) ^ binary_erosion(mask, border_value=1)


SURVEY_FOLDER = "survey"  # of an on-demand dataset: its survey, a dataset with depth and masks only
CAPTURED = "captured"  # of an on-demand dataset: records of its live capture, NAME.json


@dataclass(frozen=True)
class Frame:
    """One keyframe: its camera, its time in seconds, and the files of its images.

    on_demand: the files exist only after a run has taken the frame. Reading a file that does not
    exist yet raises InputError. In a live capture (`mgs.run.live`), capture_path is the record of
    the picture, None before it is taken; asked is the camera asked for, if the picture was taken
    from another; given_up says that no picture could be taken."""

    name: str
    camera: Camera
    timestamp: float
    image_path: Path
    depth_path: Path | None = None
    mask_path: Path | None = None
    rock_path: Path | None = None
    on_demand: bool = False
    asked: Camera | None = None
    capture_path: Path | None = None
    given_up: bool = False

    def rgb(self) -> np.ndarray:
        """Linear RGB float32 [H,W,3]. Raises InputError if missing, damaged or of another size."""
        return read_png(self._existing(self.image_path))

    def depth(self) -> np.ndarray:
        """z-depth float32 [H,W], metres, 0 = no return. Raises InputError as `rgb`, and if the
        frame has no depth file."""
        if self.depth_path is None:
            cure = "this command needs RGB-D frames"
            raise InputError(f"frame {self.name}: has no depth_file_path; {cure}")
        depth = read_depth(self._existing(self.depth_path))
        return np.nan_to_num(depth, nan=0.0, posinf=0.0, neginf=0.0)

    def mask(self) -> np.ndarray:
        """Rock mask, bool [H,W]: the mask file; else alpha >= 0.5 of the rock image; else all true.
        In rendered datasets a pixel is true if the ray through its centre meets the rock. Raises
        InputError as `rgb`."""
        if self.mask_path is not None:
            return read_mask(self._existing(self.mask_path))
        if self.rock_path is not None:
            return self.target()[0][..., 3] >= 0.5
        return np.ones((self.camera.height, self.camera.width), bool)

    def target(self) -> tuple[np.ndarray, np.ndarray]:
        """Target of a fit to the rock alone: rgba float32 [H,W,4] and weight float32 [H,W].

        rgba is linear RGB premultiplied by alpha, and alpha, the share of the pixel that the rock
        covers. weight is 1 where rgba is known, else 0. With a rock image, weight is 1 everywhere.
        With a mask only, alpha is 0 or 1, which is wrong along the outline, so the `boundary` of
        the mask has weight 0. With neither, alpha and weight are 1. Raises InputError as `rgb`."""
        if self.rock_path is not None:
            rgba = premultiplied(read_rgba(self._existing(self.rock_path)))
            return rgba, np.ones(rgba.shape[:2], np.float32)
        one = np.ones((self.camera.height, self.camera.width), np.float32)
        rgba = np.dstack([self.rgb(), one])
        if self.mask_path is None:
            return rgba, one
        mask = self.mask()
        rgba *= mask[..., None]
        return rgba, (~boundary(mask)).astype(np.float32)

    def masked_rgb(self) -> np.ndarray:
        """Colour of `target`: linear RGB float32 [H,W,3] of the rock in front of black."""
        return self.target()[0][..., :3]

    def _existing(self, path: Path) -> Path:
        """Return `path`, a file of the camera's size by its header."""
        if self.on_demand and not path.exists():
            raise InputError(
                f"{path}: does not exist, since no run has taken frame {self.name} of this "
                "on-demand dataset; `mgs nbv` takes what it chooses, and what `mgs prior` reads "
                f"is in the dataset's folder {SURVEY_FOLDER}"
            )
        (width, height), camera = image_size(path), self.camera
        if (width, height) != (camera.width, camera.height):
            why = f"is {width}x{height}, but transforms.json says {camera.width}x{camera.height}"
            raise InputError(f"{path}: {why}; correct either")
        return path


def outlines_apart(mask: np.ndarray, body: np.ndarray, margin: int) -> float:
    """Share of the pixels of two areas [H,W] where these disagree: outside the mask or inside it by
    more than `margin` pixels."""
    outside = ~binary_dilation(mask, iterations=margin)
    inside = binary_erosion(mask, iterations=margin, border_value=1)
    wrong = (body & outside) | (inside & ~body)
    return float(wrong.sum() / max((mask | body).sum(), 1))


def capture_record(frame: Frame) -> Path:
    """Path of the record of a frame's live capture; its image lies in ROOT/images."""
    return frame.image_path.parent.parent / CAPTURED / f"{frame.name}.json"


def as_captured(frame: Frame, world: World = UPRIGHT) -> Frame:
    """The frame as a live capture recorded it, with the pose and lens of its picture; itself where
    there is no record. world: that of the record. Raises InputError if the record is damaged."""
    path = capture_record(frame)
    if not frame.on_demand or frame.capture_path or not path.is_file():
        return frame
    record = read_json(path)
    try:
        if record.get("given_up"):
            return replace(frame, given_up=True)
        depth = frame.image_path.parent.parent / "depth" / f"{frame.name}.exr"
        picture = replace(
            frame, capture_path=path, depth_path=depth if record["depth"] else frame.depth_path
        )
        if record["camera"] is None:
            return picture
        camera = world.enter(Camera(**record["camera"]))
    except (AttributeError, TypeError, KeyError, ValueError, InputError):
        raise InputError(f"{path}: is damaged; delete it to capture the frame again") from None
    return replace(picture, asked=frame.camera, camera=camera)


def as_asked(frame: Frame) -> Frame:
    """The frame as it was before its live capture; a frame that was given up stays so."""
    camera = frame.asked or frame.camera
    return replace(frame, camera=camera, asked=None, capture_path=None)


def moves(given: Sequence[Frame], frames: Sequence[Frame]) -> dict[str, dict[str, float]]:
    """Move of each frame's pose, by name: degrees, and length in the dataset's unit."""
    by_name = {}
    for old, new in zip(given, frames, strict=True):
        motion = old.camera.world_to_camera @ new.camera.camera_to_world
        chord = np.linalg.norm(motion[:3, :3] - np.eye(3)) / np.sqrt(8)
        turn = 2 * np.degrees(np.arcsin(min(chord, 1.0)))
        shift = float(np.linalg.norm(motion[:3, 3]))
        by_name[old.name] = {"degrees": round(float(turn), 4), "length": shift}
    return by_name


RIM = 4  # pixels around a mask whose blur counts
GRAZING = 0.2  # least cosine of the angle between normal and view that widens the tolerance


def frame_blur(frame: Frame, mask: np.ndarray) -> float:
    """Blur of a frame's image (`mgs.metrics.blur`) in its mask [H,W] and RIM pixels around, pixels.
    The outline counts, because it is an edge of a plain object, too. Raises InputError as
    `Frame.rgb`."""
    return blur(srgb_from_linear(frame.rgb()), binary_dilation(mask, iterations=RIM))


def in_image(camera: Camera, pixels: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Whether projected points lie in front of a camera and in its image, bool [N]. pixels [N,2], z
    [N]: from `Camera.project`."""
    return (z > 0) & (pixels >= 0).all(1) & (pixels < [camera.width, camera.height]).all(1)


def visible(
    points: np.ndarray,
    normals: np.ndarray,
    camera: Camera,
    depth: np.ndarray,
    tolerance: float,
    *,
    two_sided: bool = False,
) -> np.ndarray:
    """Whether points are seen, bool [N]: in the image, facing the camera, at the pixel's depth.

    points [N,3] world, metres; normals [N,3] unit; depth [H,W] z-depth, metres, 0 = no return;
    tolerance: largest depth difference, metres; two_sided: include points that face away. The
    tolerance grows by the longer side of a pixel times the slope, as depth varies within it."""
    pixels, z = camera.project(points)
    view = camera.position - points
    cosine = np.einsum("nk,nk->n", normals, view) / np.maximum(np.linalg.norm(view, axis=1), 1e-30)
    inside = in_image(camera, pixels, z)
    if not two_sided:
        inside &= cosine > 0
    surface = np.zeros(len(points))
    column, row = np.floor(pixels[inside]).astype(int).T
    surface[inside] = depth[row, column]
    steep = np.maximum(np.abs(cosine), GRAZING)
    longer = z / min(camera.K[0, 0], camera.K[1, 1])
    slack = tolerance + longer * np.sqrt(np.maximum(1 - steep**2, 0)) / steep
    return inside & (surface > 0) & (np.abs(z - surface) < slack)


def has_masks(frames: Sequence[Frame]) -> bool:
    """Whether every frame has a mask or a rock image."""
    return all(frame.mask_path is not None or frame.rock_path is not None for frame in frames)


def mask_share(
    points: np.ndarray, frames: Sequence[Frame], slack: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Share of masks that contain each point [N,3], among the frames with it in their image, and
    the number of these frames: ([N] 0 to 1, [N]). A mask is the outline of the whole object, so
    points of the object fall into every mask, hidden or not. slack: dilation of the masks, pixels,
    for errors of points and poses."""
    inside, count = np.zeros(len(points)), np.zeros(len(points), int)
    for frame in frames:
        pixels, z = frame.camera.project(points)
        here = in_image(frame.camera, pixels, z)
        column, row = pixels[here].astype(int).T
        mask = binary_dilation(frame.mask(), iterations=slack) if slack else frame.mask()
        inside[here] += mask[row, column]
        count += here
    return inside / np.maximum(count, 1), count


def in_mask(points: np.ndarray, frame: Frame) -> np.ndarray:
    """Whether points [N,3], world, metres, project onto the rock mask, bool [N]; points outside the
    image take its nearest pixel."""
    pixels, _ = frame.camera.project(points)
    column = np.clip(np.floor(pixels[:, 0]), 0, frame.camera.width - 1).astype(int)
    row = np.clip(np.floor(pixels[:, 1]), 0, frame.camera.height - 1).astype(int)
    return frame.mask()[row, column]


def nearest_point(positions: Sequence[np.ndarray], directions: Sequence[np.ndarray]) -> np.ndarray:
    """Point [3] nearest to lines in the least-squares sense. positions, directions (unit): [3]."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for position, direction in zip(positions, directions, strict=True):
        across = np.eye(3) - np.outer(direction, direction)
        A, b = A + across, b + across @ position
    return np.linalg.lstsq(A, b, rcond=1e-9)[0]
