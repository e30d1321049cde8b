"""Markdown of which all tables are made."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any


def markdown(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; all columns but the first are right-aligned."""
    lines = [heading, ["---", *["---:"] * (len(heading) - 1)], *rows]
    return "".join(
        "|" + "".join(f" {cell} |" if cell else " |" for cell in line) + "\n" for line in lines
    )


def short(value: float, digits: int = 1) -> str:
    """A number of any size with so many significant digits, 6.1e-4."""
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def made_by(data: dict[str, Any]) -> str:
    """The command that measured the numbers, the machine where the file names it, and the
    versions."""
    command, machine, versions = data["command"], data.get("machine"), data["versions"]
    if not command.startswith("mgs "):
        command = f"python benchmarks/{command}"
    command = _as_a_loop(command)
    cores = (
        f" on {_threads(machine['threads'])} ({machine['cpu']}, {machine['simd_width']} float32 lanes)"
        if machine
        else ""
    )
    commit = f" ({versions['commit']})" if "commit" in versions else ""
    return f"\n`{command}`{cores}; mgs {versions['mgs']}{commit}, Mitsuba {versions['mitsuba']}, Dr.Jit {versions['drjit']}.\n"


def _as_a_loop(command: str) -> str:
    """A command whose last words are the same for several rocks of a study, as a loop over the
    rocks."""
    rocks = re.findall(r" \S+/cells/dataset/([\w-]+)/\S+:\S+", command)
    words = command.split()
    patterns = {
        word.replace(rock, "$r")
        for word, rock in zip(words[len(words) - len(rocks) :], rocks, strict=True)
    }
    if len(rocks) < 2 or len(patterns) > 1:
        return command
    first = " ".join(words[: len(words) - len(rocks)])
    return f"{first} $(for r in {' '.join(rocks)}; do echo {patterns.pop()}; done)"


def _threads(number: int) -> str:
    return f"{number} thread{'' if number == 1 else 's'}"
