"""Hashes of a run's inputs: a run is resumed only if these are unchanged. Files of frames that were
not taken are never opened."""

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.data.dataset import Dataset
from mgs.data.frames import Frame
from mgs.errors import InputError
from mgs.prior.build import Prior
from mgs.run import policy_file
from mgs.run.settings import NbvSettings

DECIMALS = 9  # decimals of poses and intrinsics: their last bits differ between machines


def array_digest(arrays: Iterable[np.ndarray]) -> str:
    """BLAKE2b hash of arrays with their shapes and types: 32 hexadecimal digits."""
    digest = hashlib.blake2b(digest_size=16)
    for array in arrays:
        digest.update(f"{array.dtype.str} {array.shape};".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def file_digest(path: Path) -> str:
    """BLAKE2b hash of a file: 32 hexadecimal digits. Raises InputError where it cannot be read."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{path}: cannot be read ({reason}); restore it") from None


def prior_digest(prior: Prior) -> str:
    """Hash of what a run takes from a prior: points, normals, spacing, tolerance, backing."""
    numbers = np.array([prior.spacing, prior.depth_tolerance, prior.backed])
    return array_digest([prior.points, prior.normals, numbers])


def camera_digest(camera: Camera) -> str:
    """Hash of a camera's pose, intrinsics and image size."""
    size = np.array([camera.width, camera.height])
    arrays = (camera.world_to_camera, camera.K, size)
    return array_digest([np.round(m, DECIMALS) + 0.0 for m in arrays])  # + 0.0: no negative zero


def frame_digests(frame: Frame, kinds: Iterable[str]) -> dict[str, str | None]:
    """Hashes of the files of a frame by kind: `image`, `mask`, `rock`, `depth`, `capture` (the
    record of a live capture); None of no file. Raises InputError as `file_digest`."""
    paths = {kind: getattr(frame, f"{kind}_path") for kind in kinds}
    return {kind: None if path is None else file_digest(path) for kind, path in paths.items()}


def check_unchanged(
    out: Path, record: dict[str, Any], prior: str, settings: NbvSettings, dataset: Dataset
) -> None:
    """Raises InputError that names the first input of a run which changed since its record.

    prior: hash of the prior as it is now."""
    if record["prior"] != prior:
        raise InputError(changed_prior(out, settings.prior))
    changed = f"changed since {out} was started; restore"
    if record.get("policy") != policy_record(settings.policy).get("policy"):
        raise InputError(f"policy {settings.policy}: its file has {changed} it, or start a new run")
    for frame in dataset.frames:
        if record["cameras"].get(frame.name) != camera_digest(frame.asked or frame.camera):
            where = f"{dataset.root / 'transforms.json'}: the camera of frame {frame.name} has"
            raise InputError(f"{where} {changed} it, or start a new run")
        old = record["files"].get(frame.name, {})
        for kind, digest in frame_digests(frame, old).items():
            if digest != old[kind]:
                where = f"{dataset.root / 'transforms.json'}: the {kind} of frame {frame.name}"
                file = getattr(frame, f"{kind}_path") or where
                raise InputError(f"{file} has changed since {out} took it; restore it")


def policy_record(policy: str) -> dict[str, str]:
    """The hash of a policy's file, as an entry of a record; empty for a policy of ours."""
    if not policy_file.in_file(policy):
        return {}
    return {"policy": file_digest(Path(policy.rpartition(":")[0]))}


def changed_prior(out: Path, prior: Path) -> str:
    """Message for a prior that is not the run's."""
    return f"{prior}: is not the prior that {out} was started on; restore it, or start a new run"
