"""Photographs that become more while someone takes them, as a dataset (`mgs suggest FOLDER`)."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from mgs.data.dataset import Dataset
from mgs.data.importers import import_source
from mgs.data.photographs import photographs_in
from mgs.data.sources import read_source
from mgs.data.structure import WIDEST
from mgs.files import atomic_path, folder_locked, in_the_way
from mgs.images import unlimited_headers

COPIES, DATASET = "photographs", "dataset"
"""Folders at a site: reduced copies of the photographs, and the dataset of them."""

DOWNSCALE = 3
"""Width of the copies over that of the dataset's images, which candidates are rated by."""


def holds_photographs(folder: Path) -> bool:
    """Whether a folder holds photographs alone, and no dataset, run or other source."""
    names = ("transforms.json", "transforms_train.json", "config.json", "sparse")
    known = any((folder / name).exists() for name in names)
    return folder.is_dir() and not known and bool(photographs_in(folder))


def dataset_at(folder: Path, site: Path) -> tuple[Dataset, Sequence[str]]:
    """Dataset of a folder of photographs, and notes on what was left out. site: folder for it, of
    which a later call registers the photographs since then to the same model.

    Raises InputError as `read_source`, and if `site` was made by something else.
    """
    if site.exists() and not (site / COPIES).is_dir():
        raise in_the_way(site)
    with folder_locked(site):
        root, names = site / COPIES, set[Path]()
        for path in photographs_in(folder):
            names.add(root / path.relative_to(folder))
            _copy_reduced(path, root / path.relative_to(folder))
        for path in set(photographs_in(root)) - names:
            path.unlink()
        source = read_source(root, unpack=site)
        up, _ = source.up_or_estimate()
        shutil.rmtree(site / DATASET, ignore_errors=True)
        result = import_source(source, site / DATASET, downscale=DOWNSCALE, up=up)
    return result, source.notes


def _copy_reduced(path: Path, copy: Path) -> None:
    """Write a JPEG with at most WIDEST pixels along its longer side and its EXIF data; link what is
    no JPEG, or cannot be read."""
    from PIL import Image

    if copy.exists() and copy.stat().st_mtime_ns >= path.stat().st_mtime_ns:
        return
    copy.parent.mkdir(parents=True, exist_ok=True)
    copy.unlink(missing_ok=True)
    try:
        with unlimited_headers(), Image.open(path, formats=["JPEG"]) as image:
            image.draft("RGB", (WIDEST, WIDEST))
            image.thumbnail((WIDEST, WIDEST))
            with atomic_path(copy) as temporary:
                exif = image.info.get("exif", b"")
                image.save(temporary, format="JPEG", exif=exif, quality=95)
    except OSError:
        copy.symlink_to(path.resolve())
