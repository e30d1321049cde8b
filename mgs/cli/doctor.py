"""`mgs doctor`: what mgs finds on this machine, what is wrong with it, and how to mend it."""

from __future__ import annotations

import importlib.metadata
import os
import platform

import typer

from mgs.errors import InputError

_PACKAGES = ("mgs", "mitsuba", "drjit", "numpy", "pyoidn", "pymeshlab")
"""Packages whose versions are printed. Only pyoidn may be missing."""


def doctor() -> None:
    """Print versions, the libLLVM that is used, processor and memory; say what is wrong and how to
    mend it.

    The exit code is 0 if all is well, and 2 if something prevents mgs from working.
    """
    from rich.console import Console
    from rich.table import Table

    table = Table(show_header=False, box=None, pad_edge=False)
    problems = []
    for name, value, problem in _software() + _machine() + _resources():
        table.add_row(name, value, style="red" if problem else None)
        if problem:
            problems.append(problem)
    console = Console(highlight=False)
    console.print(table)
    for problem in problems:
        console.print(f"wrong: {problem}", style="red", markup=False, soft_wrap=True)
    if problems:
        raise typer.Exit(2)
    console.print("all is well")


def _software() -> list[tuple[str, str, str]]:
    """Python and the packages: (name, value, what is wrong with it or "") of each."""
    rows = [("python", platform.python_version(), "")]
    for package in _PACKAGES:
        try:
            rows.append((package, importlib.metadata.version(package), ""))
        except importlib.metadata.PackageNotFoundError:
            optional = package == "pyoidn"
            absent = "absent: images are rendered with more samples instead of being denoised"
            problem = f"the package {package} is missing; install mgs again (`make setup`, or `pip install .`)"
            rows.append((package, absent if optional else "missing", "" if optional else problem))
    try:  # pymeshlab needs the system's libGL to load, although mgs draws nothing with it
        import pymeshlab  # noqa: F401
    except ModuleNotFoundError:
        pass  # reported above
    except ImportError as error:
        rows.append(
            (
                "pymeshlab",
                "does not load",
                f"pymeshlab: {error}; install libGL (`apt-get install libgl1 libopengl0`)",
            )
        )
    return rows


def _machine() -> list[tuple[str, str, str]]:
    """Processor, memory and libLLVM: (name, value, what is wrong with it or "") of each."""
    from mgs import runtime

    page, gib = os.sysconf("SC_PAGE_SIZE"), 1024**3
    total, free = (
        os.sysconf("SC_PHYS_PAGES") * page / gib,
        os.sysconf("SC_AVPHYS_PAGES") * page / gib,
    )
    rows = [
        ("cores", str(os.cpu_count()), ""),
        ("memory", f"{total:.1f} GiB, {free:.1f} GiB free", ""),
    ]
    try:
        library = runtime.find_libllvm()
    except InputError as error:
        return [*rows, ("libLLVM", "not usable", str(error))]
    try:
        runtime.start()
        runtime.check_kernel()
    except (InputError, ImportError) as error:
        return [*rows, ("libLLVM", str(library), str(error))]
    facts = runtime.processor()
    rows.append(("libLLVM", str(library), ""))
    rows.append(("SIMD", f"{facts['simd_width']} float32 lanes ({facts['cpu']})", ""))
    rows.append(("threads", f"{facts['threads']} (Dr.Jit)", ""))
    return rows


def _resources() -> list[tuple[str, str, str]]:
    """The folders of data files that come with mgs: (name, value, what is wrong with it or "") of
    each."""
    from mgs.resources import resource_folder

    rows = []
    for name, pattern in (("scenes", "*.toml"), ("plugins", "*.py")):
        try:
            found = sorted(path.stem for path in resource_folder(name).glob(pattern))
        except InputError as error:
            rows.append((name, "missing", str(error)))
        else:
            rows.append((name, ", ".join(found) or "none", ""))
    return rows
