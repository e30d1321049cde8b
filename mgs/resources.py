"""Where the data files of the package lie: inside an installed wheel, or at the root of a checkout."""

from __future__ import annotations

from pathlib import Path

from mgs.errors import InputError

_PACKAGE = Path(__file__).resolve().parent


def resource_folder(name: str) -> Path:
    """The folder `scenes` or `plugins`. Raises InputError where the installation lacks it."""
    for root in (_PACKAGE, _PACKAGE.parent):
        if (root / name).is_dir():
            return root / name
    raise InputError(f"mgs: the folder {name!r} is missing from the installation; install mgs again")


def scene_path(scene: str | Path) -> Path:
    """A scene's TOML file, by path or by the name of one that comes with mgs. Raises InputError where there is none."""
    if Path(scene).suffix == ".toml":
        if not Path(scene).is_file():
            raise InputError(f"{scene}: no such scene file")
        return Path(scene)
    folder = resource_folder("scenes")
    path = folder / f"{scene}.toml"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in folder.glob("*.toml")))
        raise InputError(f"scene {str(scene)!r}: unknown; choose one of {known}, or give the path of a .toml file")
    return path
