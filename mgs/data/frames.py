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


def write_rock_image(path: str | Path, rgba: np.ndarray) -> None:
    """Write linear RGB and alpha, [H,W,4] premultiplied, as 8-bit sRGB PNG, straight alpha."""
    alpha = rgba[..., 3:]
    straight = rgba[..., :3] / np.where(alpha > 0, alpha, 1)
    rgba = np.dstack([srgb_from_linear(straight), np.clip(alpha, 0, 1)])
    write_png(path, np.round(rgba * 255).astype(np.uint8))


def read_rock_image(path: str | Path) -> np.ndarray:
    """Read an sRGB PNG with straight alpha, 8 or 16 bits, as linear RGB premultiplied by alpha, and
    alpha: float32 [H,W,4]. Raises InputError as `mgs.images.read_rgba`."""
    return premultiplied(read_rgba(path))


def premultiplied(pixels: np.ndarray) -> np.ndarray:
    """sRGB with straight alpha [H,W,4], uint8 or uint16 -> premultiplied linear RGBA, float32."""
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
            rgba = read_rock_image(self._existing(self.rock_path))
            return rgba, np.ones(rgba.shape[:2], np.float32)
        mask = self.mask()
        rgba = np.dstack([self.rgb(), np.ones(mask.shape, np.float32)]) * mask[..., None]
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
