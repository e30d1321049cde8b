"""Options that several commands share, and settings as KEY=VALUE."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import typer
from pydantic import BaseModel

from mgs.errors import InputError

Command = TypeVar("Command", bound=Callable[..., None])


def option(text: str, *flags: str, **more: Any) -> Any:
    """A `typer.Option` with this help."""
    return typer.Option(*flags, help=text, **more)


def argument(text: str, **more: Any) -> Any:
    """A `typer.Argument` with this help."""
    return typer.Argument(help=text, **more)


def setting(model: type[BaseModel], key: str, more: str = "", metavar: str | None = None) -> Any:
    """The option of a setting; its help is the docstring of the field, its default and `more`."""
    name, default, text = next(row for row in keys_of(model) if row[0] == key)
    flag = "--" + name.rpartition(".")[2].replace("_", "-")
    shown = f" Default: {default}." if default and "Default" not in text + more else ""
    return typer.Option(flag, help=f"{text}{shown}{more}", show_default=False, metavar=metavar)


Runs = Annotated[list[Path], argument("Folders that `mgs nbv` wrote.", metavar="RUN...")]
DatasetFolder = Annotated[Path, argument("Dataset folder (transforms.json).")]
Seed = Annotated[
    int, option("Seed of all random draws: the same seed gives the same result.", min=0)
]
Force = Annotated[bool, option("Replace an existing output.", "--force")]
Gaussians = Annotated[
    str | None,
    option("Build a prior of this many Gaussians in the run folder.", metavar="N|auto"),
]
Settings = Annotated[
    list[str] | None,
    option("Any setting of the table below; repeatable.", "--set", metavar="KEY=VALUE"),
]
Config = Annotated[
    Path | None,
    option(
        "File of settings with these keys, or the config.json of a run. Options override it.",
        metavar="FILE.toml",
    ),
]


def keys_of(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, str, str]]:
    """Key, default and description of each setting; keys of a model within it have a dot."""
    for name, field in model.model_fields.items():
        default, text = field.default, " ".join((field.description or "").split())
        if isinstance(default, BaseModel):
            yield from keys_of(type(default), f"{prefix}{name}.")
        elif isinstance(default, Mapping):
            numbers = ", ".join(f"{kind} {number:g}" for kind, number in default.items())
            yield f"{prefix}{name}.KIND", numbers, text
        elif field.is_required() or default in (None, (), False):
            yield f"{prefix}{name}", "", text
        else:
            shown = str(default).lower() if isinstance(default, bool) else str(default)
            yield f"{prefix}{name}", shown, text


def with_keys(model: type[BaseModel], *fields: str) -> Callable[[Command], Command]:
    """Give a command with --set the `keys` that it takes: those of these fields; by default all."""

    def decorate(function: Command) -> Command:
        rows = keys_of(model)
        keys = [row for row in rows if not fields or row[0].partition(".")[0] in fields]
        function.keys = keys  # type: ignore[attr-defined]
        return function

    return decorate


def parse_settings(pairs: Sequence[str] | None, command: Any) -> dict[str, Any]:
    """Nested settings of texts KEY=VALUE, with the values of TOML; other values are strings.

    Raises InputError for a text of another form, and for a key that the command does not take.
    """
    settings = dict[str, Any]()
    for pair in pairs or ():
        key, equals, text = pair.partition("=")
        if not equals:
            raise InputError(f"--set {pair}: expected KEY=VALUE, as in train.passes=20")
        if not any(_names(key, row[0]) for row in command.keys):
            raise InputError(f"--set {pair}: unknown setting; --help lists them")
        *parents, name = key.split(".")
        table: Any = settings
        for parent in parents:
            table = table.setdefault(parent, {})
        table[name] = _value(text)
    return settings


def _names(key: str, row: str) -> bool:
    """Whether a key is a row of the table, or a kind of a setting that has a number for each."""
    stem = row.removesuffix("KIND")
    return key == row or (stem != row and key.startswith(stem))


def _value(text: str) -> Any:
    """Value of a setting: as in TOML, a list also without brackets; otherwise the text."""
    for written in (text, f"[{text}]"):
        try:
            return tomllib.loads(f"value = {written}")["value"]
        except tomllib.TOMLDecodeError:
            continue
    return text


def merged(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of both; the second wins, table by table."""
    result = dict(first)
    for key, value in second.items():
        nested = isinstance(value, Mapping) and isinstance(result.get(key), Mapping)
        result[key] = merged(result[key], value) if nested else value
    return result


def given(**options: Any) -> dict[str, Any]:
    """Keep the options that are not None."""
    return {name: value for name, value in options.items() if value is not None}


def parse_up(text: str) -> tuple[float, float, float] | None:
    """Unit vector of an option like 0,0,1; None for auto. Raises InputError for anything else."""
    from mgs.data.up import unit_up

    if text == "auto":
        return None
    try:
        return unit_up([float(part) for part in text.split(",")])
    except (ValueError, InputError):
        raise InputError(
            f"up {text!r}: expected auto, or three numbers X,Y,Z that are not all zero, as in 0,0,1"
        ) from None


def parse_gaussians(text: str | None, key: str = "gaussians") -> int | Literal["auto"] | None:
    """Number of an option, or auto. Raises InputError for anything else."""
    if text is None or text == "auto":
        return text  # type: ignore[return-value]
    try:
        count = int(text)
    except ValueError:
        count = 0
    if count < 1:
        raise InputError(f"{key} {text!r}: expected a whole number of at least 1, or auto")
    return count
