"""What a run was made from, as hashes: a resumed run goes on from the same, or not at all.

A record holds `prior`: the hash of the prior; `cameras`: of the pose and the intrinsics of every
frame, by its name; `files`: of the files of each frame taken, by its name and their kind; `policy`:
of the file of a policy of the user's own, if it is one. Files of frames that were not taken are
never opened.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mgs.camera import Camera
from mgs.data.dataset import Dataset, Frame
from mgs.data.up import PLUS_Z
from mgs.errors import InputError
from mgs.policy import from_file as policy_file

if TYPE_CHECKING:
    from mgs.prior.build import Prior
    from mgs.run.folder import State
    from mgs.run.settings import NbvSettings

DECIMALS = 9
"""Of poses (metres, cosines) and intrinsics (pixels): the last bits of an inverse matrix differ
between machines."""


def array_digest(arrays: Iterable[np.ndarray]) -> str:
    """BLAKE2b hash of arrays, their shapes and types included: 32 hexadecimal digits."""
    found = hashlib.blake2b(digest_size=16)
    for array in arrays:
        found.update(f"{array.dtype.str} {array.shape};".encode())
        found.update(np.ascontiguousarray(array).data)
    return found.hexdigest()


def file_digest(path: Path) -> str:
    """BLAKE2b hash of a file: 32 hexadecimal digits. Raises InputError where it cannot be read."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror or error}); restore it"
        ) from None


def prior_digest(prior: Prior) -> str:
    """Hash of what a run takes from a prior: points, normals, spacing and depth tolerance; which
    way is up, where not +Z."""
    up = [np.array(prior.up)] if prior.up != PLUS_Z else []
    return array_digest(
        [
            prior.points,
            prior.normals,
            np.array([prior.spacing, prior.depth_tolerance, prior.backed]),
            *up,
        ]
    )


def camera_digest(camera: Camera) -> str:
    """Hash of a camera's pose, intrinsics and image size."""
    size = np.array([camera.width, camera.height])
    return array_digest(
        [np.round(m, DECIMALS) + 0.0 for m in (camera.world_to_camera, camera.K, size)]
    )  # + 0.0: no -0


def frame_digests(frame: Frame, kinds: Iterable[str]) -> dict[str, str | None]:
    """Hashes of the files of a frame, of those kinds: `image`, `mask`, `rock`, `depth`; None of one
    that it has not.

    Raises InputError as `file_digest`.
    """
    return {
        kind: None if (path := _path(frame, kind)) is None else file_digest(path) for kind in kinds
    }


def _path(frame: Frame, kind: str) -> Path | None:
    return {
        "image": frame.image_path,
        "mask": frame.mask_path,
        "rock": frame.rock_path,
        "depth": frame.depth_path,
    }[kind]


def check(
    out: Path,
    state: State,
    settings: NbvSettings,
    dataset: Dataset,
    prior: str,
    say: Callable[[str], None],
) -> None:
    """Raises InputError where a run cannot go on from what it was made from; says so where that was
    never recorded."""
    if state.inputs:
        check_unchanged(out, state.inputs, prior, settings.prior, dataset)
        check_same_policy(out, state.inputs, settings.policy)
    elif len(state.steps) <= settings.budget:
        say(
            f"{out}: was started by a version that kept no record of its inputs; it goes on with the files as they are now"
        )


def check_unchanged(
    out: Path, record: dict[str, Any], prior: str, prior_path: Path, dataset: Dataset
) -> None:
    """Raises InputError, naming the first thing that changed, where a record is not of this prior
    (its hash) and dataset."""
    if record["prior"] != prior:
        raise InputError(changed_prior(out, prior_path))
    for frame in dataset.frames:
        if record["cameras"].get(frame.name) != camera_digest(frame.camera):
            where = f"{dataset.root / 'transforms.json'}: the pose or the intrinsics of frame {frame.name} have"
            raise InputError(
                f"{where} changed since {out} was started; restore them, or start a new run"
            )
        known = record["files"].get(frame.name, {})
        for kind, digest in frame_digests(frame, known).items():
            if digest != known[kind]:
                file = (
                    _path(frame, kind)
                    or f"{dataset.root / 'transforms.json'}: the {kind} of frame {frame.name}"
                )
                raise InputError(
                    f"{file} has changed since {out} took it; restore it, or start a new run"
                )


def policy_record(policy: str) -> dict[str, str]:
    """The hash of a policy's file, as an entry of a record; nothing for a policy that is in no
    file."""
    return (
        {"policy": file_digest(policy_file.file_of(policy))} if policy_file.in_file(policy) else {}
    )


def check_same_policy(out: Path, record: dict[str, Any], policy: str) -> None:
    """Raises InputError where the file of the policy is another than that of the record."""
    if record.get("policy") != policy_record(policy).get("policy"):
        raise InputError(
            f"policy {policy}: its file has changed since {out} was started; restore it, or start a new run"
        )


def changed_prior(out: Path, prior: Path) -> str:
    """What to say where the prior is another one."""
    return f"{prior}: is not the prior that {out} was started on; restore it, or start a new run"


def moved_start(out: Path, prior: Path) -> str:
    """What to say where Gaussians do not lie where a run of this prior starts them."""
    other = f"{out} is of a version of mgs that puts Gaussians elsewhere"
    return f"{prior}: is not the prior that {out} was started on, or {other}; restore it, or start a new run"
