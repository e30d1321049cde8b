"""Options that several commands share, and settings as KEY=VALUE."""

import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from inspect import cleandoc
from typing import Annotated, Any, Literal, TypeVar

import typer
from pydantic import BaseModel

from mgs.errors import InputError

Command = TypeVar("Command", bound=Callable[..., None])


SHARED = """Options of several commands.

- runs RUN...: Folders that `mgs nbv` wrote.
- dataset: Dataset folder (transforms.json).
- prior: Folder of `mgs prior`. Default: DATASET/prior, or one built in the run.
- gaussians N|auto: Build a prior of this many Gaussians in the run folder.
- seed: Seed of all random draws: the same seed gives the same result.
- settings KEY=VALUE: Any setting of the table below; repeatable.
- config FILE.toml: File of settings with these keys, or the config.json of a run. Options override
  it.
- force: Replace an existing output.
"""
"""Help of options that several commands share."""

PLACES = ("dataset", "prior")  # settings that are folders, which commands take as arguments

Row = tuple[str, str, str]
"""Key, default and description of a setting."""

Settings = Annotated[list[str] | None, typer.Option("--set")]
Seed = Annotated[int, typer.Option(min=0)]
Count = Annotated[int | None, typer.Option(min=1)]


def describe(command: Any, docstring: str, keys: Sequence[Row]) -> None:
    """Set the help of a command and its options from the docstring of its function.

    The list at its end has an item `- NAME METAVAR: help` for each option that is not in SHARED.
    Where an option is a setting (keys: rows of `keys_of`), the text of the setting and its default
    come first. A switch that is off by default has no form that turns it off. `keys` of the command
    are the settings that are no option."""
    train_first = sorted(keys, key=lambda row: not row[0].startswith("train."))  # `seed` wins
    settings = {key.removeprefix("train."): row for key, *row in train_first}
    shared = _items(SHARED)[1]
    command.help, items = _items(docstring)
    for parameter in command.params:
        name = parameter.name
        metavar, text = (shared | items).get(name, ("", parameter.help))
        if name in settings and name not in PLACES:
            default, of_setting = settings[name]
            text = of_setting if name in shared else f"{of_setting} {text or ''}".strip()
            text += f" Default: {default}." if default and "Default" not in text else ""
        parameter.help, parameter.metavar = text, metavar or parameter.metavar
        if "Default" in (text or ""):
            parameter.show_default = False
        if parameter.default is False:
            parameter.secondary_opts = []
    own = {*PLACES, *(parameter.name for parameter in command.params)}
    command.keys = [row for row in keys if row[0].removeprefix("train.") not in own]


def _items(docstring: str) -> tuple[str, dict[str, tuple[str, str]]]:
    """Text of a docstring, a line for each paragraph, and name -> (metavar, help) of its list."""
    text, *items = re.split(r"\n\n?- ", cleandoc(docstring))
    heads = [" ".join(item.split()).partition(": ") for item in items]
    parts = [(*head.partition(" ")[::2], words) for head, _, words in heads]
    paragraphs = [" ".join(paragraph.split()) for paragraph in text.split("\n\n")]
    return "\n\n".join(paragraphs), {name: (metavar, words) for name, metavar, words in parts}


def keys_of(model: type[BaseModel], prefix: str = "") -> Iterator[Row]:
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
            value = str(default).lower() if isinstance(default, bool) else str(default)
            yield f"{prefix}{name}", value, text


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

    Raises InputError for a text of another form, and for a key that the command does not take."""
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
    return key == row or (stem != row and key.rpartition(".")[0] + "." == stem)


def _value(text: str) -> Any:
    """Value of a setting: as in TOML, a list also without brackets; otherwise the text."""
    for toml in (text, f"[{text}]"):
        try:
            return tomllib.loads(f"value = {toml}")["value"]
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


def not_none(**options: Any) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


def refuse_unused(where: str, **options: Any) -> None:
    """Raise InputError for the first of these options that is given. where: ends the sentence."""
    for name in not_none(**options):
        raise InputError(f"--{name.replace('_', '-')}: is not used {where}; leave it out")


def parse_up(text: str) -> tuple[float, float, float] | None:
    """Unit vector of an option like 0,0,1; None for auto. Raises InputError for anything else."""
    from mgs.data.world import unit_up

    if text == "auto":
        return None
    try:
        return unit_up([float(part) for part in text.split(",")])
    except (ValueError, InputError):
        form = "auto, or three numbers that are not all zero, as in 0,0,1"
        raise InputError(f"up {text!r}: expected {form}") from None


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
