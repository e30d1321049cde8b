"""A growing folder of photographs as a dataset (`mgs suggest FOLDER`)."""

import shutil
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from mgs.data.dataset import Dataset
from mgs.data.depth_beside import depth_files
from mgs.data.importers import import_source
from mgs.data.photographs import check_alone, depth_places, photographs_in
from mgs.data.sources import read_source
from mgs.data.structure import WIDEST
from mgs.files import (
    atomic_path,
    below,
    check_leftover,
    folder_locked,
    not_writable,
    parsing,
    read_json,
    remove_file,
    remove_leftovers,
    write_json,
)
from mgs.images import unlimited_headers

COPIES, DATASET = "photographs", "dataset"  # folders of a site: reduced copies, their dataset
RECORD = "copies.json"  # names of the copies; marks a site, where only these are ever removed
DOWNSCALE = 3  # width of the copies over that of the dataset's images, which rate candidates


def holds_photographs(folder: Path) -> bool:
    """Whether a folder holds photographs alone, and no dataset, run or other source."""
    names = ("transforms.json", "transforms_train.json", "config.json", "sparse")
    other = any((folder / name).exists() for name in names)
    return folder.is_dir() and not other and bool(photographs_in(folder))


def dataset_at(folder: Path, site: Path) -> tuple[Dataset, Sequence[str]]:
    """Dataset of a folder of photographs, and notes on what was left out. site: folder for it, of
    which a later call registers the photographs since then to the same model. Raises InputError as
    `read_source`, and if `site` was made by something else."""
    check_alone(folder)
    record = site / RECORD
    if not record.is_file():
        check_leftover(site)
    with folder_locked(site):
        remove_leftovers(site)
        root, data = below(site, COPIES), below(site, DATASET)
        with parsing(record, "list of copies", f"delete {site}"):
            before = [str(name) for name in read_json(record)] if record.is_file() else []
        paths = [*photographs_in(folder), *depth_files(*depth_places(folder))]
        names = [str(path.relative_to(folder)) for path in paths]
        write_json(record, sorted({*before, *names}))
        for name in set(before) - set(names):
            remove_file(root, root / name)
        for name in names:
            _copy_reduced(folder / name, below(root, Path(name).parent) / Path(name).name)
        write_json(record, names)
        source = read_source(root, unpack=site)
        up, _ = source.up_or_estimate()
        shutil.rmtree(data, ignore_errors=True)
        result = import_source(source, data, downscale=DOWNSCALE, up=up)
    return result, source.notes


def _copy_reduced(path: Path, copy: Path) -> None:
    """Write a JPEG with at most WIDEST pixels along its longer side and its EXIF data; link what is
    no JPEG, or cannot be read."""
    if copy.exists() and copy.stat().st_mtime_ns >= path.stat().st_mtime_ns:
        return
    try:
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.unlink(missing_ok=True)
    except OSError as error:
        raise not_writable(copy, error) from None
    try:
        with unlimited_headers(), Image.open(path, formats=["JPEG"]) as image:
            image.draft("RGB", (WIDEST, WIDEST))
            image.thumbnail((WIDEST, WIDEST))
            with atomic_path(copy) as temporary:
                exif = image.info.get("exif", b"")
                image.save(temporary, format="JPEG", exif=exif, quality=95)
    except OSError:
        copy.symlink_to(path.resolve())
