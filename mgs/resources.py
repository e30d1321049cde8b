"""Data files that come with mgs: inside the package of a wheel, beside that of a checkout."""

from pathlib import Path

from mgs.errors import InputError

_PACKAGE = Path(__file__).resolve().parent


def resource_folder(name: str) -> Path:
    """Path of the folder `scenes` or `plugins`. Raises InputError if the installation lacks it."""
    for root in (_PACKAGE, _PACKAGE.parent):
        if (root / name).is_dir():
            return root / name
    raise InputError(f"mgs: the folder {name!r} is missing; install mgs again")


def scene_path(scene: str | Path) -> Path:
    """Path of a scene's TOML file, from that path or from a name such as "boulder". Raises
    InputError if there is no such file or name."""
    if Path(scene).suffix == ".toml":
        if not Path(scene).is_file():
            raise InputError(f"{scene}: no such scene file")
        return Path(scene)
    folder = resource_folder("scenes")
    path = folder / f"{scene}.toml"
    if not path.is_file():
        names = ", ".join(sorted(p.stem for p in folder.glob("*.toml")))
        raise InputError(f"scene {str(scene)!r}: unknown; choose one of {names}, or a .toml file")
    return path
