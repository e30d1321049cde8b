"""Does what a page of docs/ tells its readers to do, and compares what is printed with what the
page shows.

    python tools/pages.py            # run docs/tutorial.md in a new folder; exit code 1 where it
    shows something else python tools/pages.py --write    # the same, and write what was printed,
    and the pictures, into docs/

A page is read as its readers take it. Blocks of Python run one after another in one program,
started in one folder. A block with a title is a file of that name. In a block marked `sh`, each
line is a command: `mgs ...`, or `python FILE ...`. A block marked `text` shows what the block
before it prints.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import re
import runpy
import shlex
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
TUTORIAL = ROOT / "docs/tutorial.md"

PICTURES = {
    "out/report/orbit.png": "tutorial_orbit.png",
    "out/report/comparison.png": "tutorial_comparison.png",
}
"""Files that the tutorial writes, and their names in docs/images."""

FENCE = re.compile(
    r'^```(?P<language>\w+)(?: title="(?P<title>[^"]+)")?\n(?P<body>.*?)^```$',
    re.MULTILINE | re.DOTALL,
)

TOLERANCE = 0.05
"""Numbers with a decimal point are compared to this share: processors, and versions of LLVM, round
differently."""


@dataclass(frozen=True)
class Block:
    """A fenced block. line: of the page, where its body starts; start, end: the same in characters,
    and where it ends."""

    language: str
    title: str | None
    body: str
    line: int
    start: int
    end: int


@dataclass(frozen=True)
class Said:
    """What a block printed, and the block of the page that shows it, where there is one."""

    block: Block
    printed: str
    shown: Block | None


def blocks(page: str) -> list[Block]:
    """The fenced blocks of a page that name their language."""
    found = []
    for match in FENCE.finditer(page):
        start, end = match.span("body")
        found.append(
            Block(
                match["language"],
                match["title"],
                match["body"],
                page.count("\n", 0, start) + 1,
                start,
                end,
            )
        )
    return found


def commands(block: Block) -> list[list[str]]:
    """The command lines of a block, each as its words, comments left out."""
    lines = block.body.replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def follow(path: Path, folder: Path) -> list[Said]:
    """Do what the page tells, in the folder: write its files, run its Python and its commands;
    returns what they printed.

    Where one fails, its exception is raised; the traceback of Python on the page has the page's
    line numbers.
    """
    found, variables, said = (
        blocks(path.read_text(encoding="utf-8")),
        {"__name__": "__main__"},
        list[Said](),
    )
    with contextlib.chdir(folder), _importable(folder):
        for block, following in zip(found, [*found[1:], None], strict=True):
            shown = following if following is not None and following.language == "text" else None
            with contextlib.redirect_stdout(io.StringIO()) as printed:
                if block.title is not None:
                    (folder / block.title).write_text(block.body, encoding="utf-8")
                elif block.language == "python":
                    exec(
                        compile("\n" * (block.line - 1) + block.body, str(path), "exec"), variables
                    )
                elif block.language == "sh":
                    for words in commands(block):
                        command(words)
                else:
                    continue
            said.append(Said(block, printed.getvalue(), shown))
    return said


@contextlib.contextmanager
def _importable(folder: Path) -> Iterator[None]:
    """Let programs import the files in the folder, as Python does for those started there."""
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))


def command(words: list[str]) -> None:
    """`mgs ...` or `python FILE ...`, in this process. Raises RuntimeError where it ends with an
    exit code."""
    before = sys.argv
    try:
        if words[0] == "mgs":
            from mgs.cli import app

            app.main(words[1:])
        elif words[0] == "python":
            sys.argv = words[1:]
            runpy.run_path(words[1], run_name="__main__")
        else:
            raise RuntimeError(f"{words[0]}: not a command of these pages")
    except SystemExit as stop:
        if stop.code:
            raise RuntimeError(f"{shlex.join(words)}: exit code {stop.code}") from None
    finally:
        sys.argv = before


def alike(shown: str, printed: str) -> bool:
    """Whether a page shows what is printed: words and whole numbers as they are, others within
    TOLERANCE."""
    number = re.compile(r"-?\d+\.\d+(?:e[+-]?\d+)?")
    if number.sub("0.0", shown).split() != number.sub("0.0", printed).split():
        return False
    pairs: Any = zip(number.findall(shown), number.findall(printed), strict=True)
    return all(math.isclose(float(a), float(b), rel_tol=TOLERANCE) for a, b in pairs)


def stale(said: list[Said]) -> list[str]:
    """What the page shows otherwise than it was printed, a line each."""
    return [
        f"line {one.shown.line}: shows\n{one.shown.body}but this was printed:\n{one.printed}"
        for one in said
        if one.shown is not None and not alike(one.shown.body, one.printed)
    ]


def rewritten(page: str, said: list[Said]) -> str:
    """The page, showing what was printed."""
    for one in reversed(said):
        if one.shown is not None:
            page = page[: one.shown.start] + one.printed + page[one.shown.end :]
    return page


def main(arguments: list[str]) -> int:
    """Run the tutorial; with --write also renew what it shows. Returns the exit code."""
    with tempfile.TemporaryDirectory() as folder:
        said = follow(TUTORIAL, Path(folder))
        if "--write" in arguments:
            TUTORIAL.write_text(
                rewritten(TUTORIAL.read_text(encoding="utf-8"), said), encoding="utf-8"
            )
            for source, name in PICTURES.items():
                shutil.copyfile(Path(folder) / source, ROOT / "docs/images" / name)
            return 0
    differences = stale(said)
    print(
        "\n".join(
            [f"{os.path.relpath(TUTORIAL)}: {text}" for text in differences]
            or ["the tutorial prints what it shows"]
        )
    )
    return int(bool(differences))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
