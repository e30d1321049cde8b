"""What a command asks of a reproduction: which results, over how many rocks, with which policies,
meshes and batches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from mgs.errors import InputError
from mgs.policy import from_file as policy_file
from mgs.policy.registry import policy_named
from mgs.run.inputs import file_digest
from mgs.study import reproduce
from mgs.study.reproduce import Mesh, Preset
from mgs.study.statistics import MOST_ROCKS
from mgs.study.sweep import names_of


def results_of(only: str | None) -> list[str]:
    """The results to make: those named, with commas between, or all that are not optional. In the
    order of RESULTS.

    Raises InputError for a name that is none.
    """
    if only is None:
        return [name for name, result in reproduce.RESULTS.items() if not result.optional]
    return names_of(only, reproduce.RESULTS)


def rocks_of(name: str, preset: Preset, asked: int | None) -> int:
    """How many rocks a result has: as many as asked for, but Table I has one. Raises InputError if
    out of range."""
    result = reproduce.RESULTS[name]
    if asked is None or name not in over_rocks():
        return result.rocks(preset)
    most = len(preset.meshes) or result.most
    if not 1 <= asked <= most:
        raise InputError(f"--rocks {asked}: {name} can have 1 to {most}")
    return asked


def over_rocks() -> list[str]:
    """The results over many rocks."""
    return [name for name in reproduce.RESULTS if name not in ("table1", "figures")]


def with_policies(preset: Preset, names: list[str], policies: Sequence[str]) -> Preset:
    """A preset whose curves and pools compare these policies, too: names, or FILE.py:FUNCTION.

    names: the results to make. Raises InputError where none of them compares policies over rocks,
    where there is no such policy, where it is compared anyway, and where two would have the same
    name in tables.
    """
    labels = list(reproduce.POLICIES)
    for policy in policies:
        if not {"curves", "pools"} & set(names):
            raise InputError(
                f"--policy {policy}: is for curves and pools, and --only leaves both out"
            )
        if policy in reproduce.POLICIES:
            raise InputError(f"--policy {policy}: is compared anyway")
        if policy_file.label(policy) in labels:
            raise InputError(
                f"--policy {policy}: there is one of this name already; leave it out, or rename its file"
            )
        labels.append(policy_file.label(policy))
        policy_named(policy)
    return replace(preset, own_policies=tuple(policy_file.absolute(policy) for policy in policies))


def with_meshes(preset: Preset, names: list[str], meshes: Sequence[Path]) -> Preset:
    """A preset whose results over many rocks are over these meshes instead.

    names: the results to make. Raises InputError where none of them is over many rocks, a file
    cannot be read, two have the same name, or they are more than MOST_ROCKS.
    """
    if not meshes:
        return preset
    if len(meshes) > MOST_ROCKS:
        raise InputError(
            f"--mesh: {len(meshes)} files; differences are tested over {MOST_ROCKS} rocks at most, leave some out"
        )
    if not set(names) & set(over_rocks()):
        raise InputError(
            f"--mesh {meshes[0]}: is for results over many rocks, and --only leaves them out"
        )
    for k, mesh in enumerate(meshes):
        if mesh.stem in [other.stem for other in meshes[:k]]:
            raise InputError(
                f"--mesh {mesh}: there is one of this name already; leave it out, or rename its file"
            )
    found, count = tuple(Mesh(mesh.resolve(), file_digest(mesh)) for mesh in meshes), len(meshes)
    return replace(preset, meshes=found, curve_rocks=count, seed_rocks=count, pool_rocks=count)


def with_batch(preset: Preset, names: list[str], batch: int) -> Preset:
    """A preset whose Table I, and so its figures, has runs that choose so many views before they
    fit again.

    names: the results to make. Raises InputError where neither is among them.
    """
    if batch == 1:
        return preset
    if not {"table1", "figures"} & set(names):
        raise InputError(f"--batch {batch}: is for table1 and figures, and --only leaves both out")
    return replace(preset, table=replace(preset.table, batch=batch))
