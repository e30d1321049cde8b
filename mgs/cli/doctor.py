"""`mgs doctor`: what mgs finds on this machine, what is wrong with it, and how to mend it."""

import os
from importlib.util import find_spec

import typer
from rich.table import Table

from mgs import runtime
from mgs.cli.terminal import Terminal
from mgs.errors import EXTRAS, InputError
from mgs.provenance import versions
from mgs.resources import resource_folder

Row = tuple[str, str, str]
"""Name, value, and what is wrong with it, or ""."""


def doctor() -> None:
    """Print versions, the libLLVM that is used, processor and memory; say what is wrong and how to
    mend it.

    The exit code is 0 if all is well, and 2 if something prevents mgs from working."""
    rows = _software() + _machine() + _resources()
    table = Table(show_header=False, box=None, pad_edge=False)
    for name, value, problem in rows:
        table.add_row(name, value, style="red" if problem else None)
    console = Terminal()
    console.print(table)
    problems = [problem for *_, problem in rows if problem]
    for problem in problems:
        console.print(f"wrong: {problem}", style="red", markup=False, soft_wrap=True)
    if problems:
        raise typer.Exit(2)
    console.print("all is well")


def _software() -> list[Row]:
    rows = []
    for name, version in versions().items():
        mend = "install mgs again (`make setup`, or `pip install .`)"
        lacks = f"the package {name} is missing; {mend}" if version == "unknown" else ""
        rows.append((name, version, lacks))
    for extra in dict.fromkeys(EXTRAS.values()):
        names = [name for name, of in EXTRAS.items() if of == extra]
        absent = [name for name in names if find_spec(name) is None]
        lacks = f'no {", ".join(absent)}: `pip install "mgs[{extra}]"`' if absent else "installed"
        rows.append((f"mgs[{extra}]", lacks, ""))
    try:  # pymeshlab needs the system's libGL to load, although mgs draws nothing with it
        import pymeshlab  # noqa: F401
    except ModuleNotFoundError:
        pass  # an extra, reported above
    except ImportError as error:
        mend = "install libGL (`apt-get install libgl1 libopengl0`)"
        rows.append(("pymeshlab", "does not load", f"pymeshlab: {error}; {mend}"))
    return rows


def _machine() -> list[Row]:
    gib = 1024**3 / os.sysconf("SC_PAGE_SIZE")
    total, free = os.sysconf("SC_PHYS_PAGES") / gib, os.sysconf("SC_AVPHYS_PAGES") / gib
    memory = f"{total:.1f} GiB, {free:.1f} GiB free"
    rows = [("cores", str(os.cpu_count()), ""), ("memory", memory, "")]
    try:
        runtime.start()
        runtime.check_kernel()
    except (InputError, ImportError) as error:
        return [*rows, ("variant", "not usable", str(error))]
    facts = runtime.processor()
    rows.append(("variant", str(facts["variant"]), ""))
    if not str(facts["variant"]).startswith("llvm"):
        return rows
    lanes = f"{facts['simd_width']} float32 lanes ({facts['cpu']})"
    threads = f"{facts['threads']} (Dr.Jit)"
    library = str(runtime.find_libllvm())
    return [*rows, ("libLLVM", library, ""), ("SIMD", lanes, ""), ("threads", threads, "")]


def _resources() -> list[Row]:
    rows = []
    for name, pattern in (("scenes", "*.toml"), ("plugins", "*.py")):
        try:
            names = sorted(path.stem for path in resource_folder(name).glob(pattern))
            rows.append((name, ", ".join(names) or "none", ""))
        except InputError as error:
            rows.append((name, "missing", str(error)))
    return rows
