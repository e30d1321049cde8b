"""Run what a page of docs/ shows its readers, and compare the printed output with the page.

    python tools/pages.py            # run docs/tutorial.md; exit code 1 where its output differs
    python tools/pages.py --write    # and write output, pictures and the notebooks

Python blocks run in order, in one program and one folder. A block with a title is a file of that
name. In a block marked `sh`, each line is a command, `mgs ...` or `python FILE ...`. A block marked
`text` shows what the block before it prints.
"""

import contextlib
import io
import json
import math
import re
import runpy
import shlex
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
TUTORIAL = ROOT / "docs/tutorial.md"
NOTEBOOKS = (TUTORIAL, ROOT / "docs/howto/policy.md")
"""Pages that are notebooks too."""

PICTURES = {
    "out/report/orbit.png": "tutorial_orbit.png",
    "out/report/comparison.png": "tutorial_comparison.png",
}
"""Files that the tutorial writes, and their names in docs/images."""

FENCE = re.compile(
    r'^```(?P<language>\w+)(?: title="(?P<title>[^"]+)")?\n(?P<body>.*?)^```$',
    re.MULTILINE | re.DOTALL,
)

NUMBER = re.compile(r"-?\d+\.\d+(?:e[+-]?\d+)?")
TOLERANCE = 0.05
"""Relative tolerance of numbers with a decimal point: processors round differently."""


def run_page(path: Path, folder: Path) -> tuple[str, list[str]]:
    """Run a page in a folder.

    Returns the page with the output that was printed, and one line for each block that shows
    another output. Tracebacks have the line numbers of the page.
    """
    page = path.read_text(encoding="utf-8")
    variables: dict[str, Any] = {"__name__": "__main__"}
    printed, differences = "", list[str]()

    def run(match: re.Match[str]) -> str:
        nonlocal printed
        language, title, body = match.groups()
        line = page.count("\n", 0, match.start("body")) + 1
        if language == "text":
            if not alike(body, printed):
                differences.append(f"line {line}: shows\n{body}but this was printed:\n{printed}")
            return match[0].replace(body, printed)
        with contextlib.redirect_stdout(io.StringIO()) as output:
            if title is not None:
                (folder / title).write_text(body, encoding="utf-8")
            elif language == "python":
                exec(compile("\n" * (line - 1) + body, str(path), "exec"), variables)
            elif language == "sh":
                for words in command_lines(body):
                    run_command(words)
        printed = output.getvalue()
        return match[0]

    with contextlib.chdir(folder), _importable(folder):
        return FENCE.sub(run, page), differences


def command_lines(body: str) -> list[list[str]]:
    """Return the words of each command line, without comments."""
    lines = body.replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def run_command(words: list[str]) -> None:
    """Run `mgs ...` or `python FILE ...` in this process; RuntimeError unless it exits with 0."""
    before = sys.argv
    try:
        if words[0] == "mgs":
            from mgs.cli import app

            app.main(words[1:])
        elif words[0] == "python":
            sys.argv = words[1:]
            runpy.run_path(words[1], run_name="__main__")
        else:
            raise RuntimeError(f"{words[0]}: only mgs and python run here")
    except SystemExit as stop:
        if stop.code:
            raise RuntimeError(f"{shlex.join(words)}: exit code {stop.code}") from None
    finally:
        sys.argv = before


@contextlib.contextmanager
def _importable(folder: Path) -> Iterator[None]:
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))


def alike(shown: str, printed: str) -> bool:
    """Whether words and whole numbers are equal, and other numbers within TOLERANCE."""
    if NUMBER.sub("0.0", shown).split() != NUMBER.sub("0.0", printed).split():
        return False
    pairs = zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True)
    return all(math.isclose(float(a), float(b), rel_tol=TOLERANCE) for a, b in pairs)


def notebook(page: str) -> str:
    """Return a page as a Jupyter notebook: its blocks are code cells with their output.

    A file is written by `%%writefile`. Commands run after `!` by the kernel's own Python, since its
    PATH may lead to none or another.
    """
    cells: list[dict[str, Any]] = []

    def add(kind: str, source: str, **more: Any) -> None:
        if source.strip():
            lines = source.strip().splitlines(keepends=True)
            cells.append({"cell_type": kind, "id": f"cell-{len(cells)}", "metadata": {}, **more})
            cells[-1]["source"] = lines

    end = 0
    for match in FENCE.finditer(page):
        add("markdown", page[end : match.start()])
        if match["language"] == "text":
            lines = match["body"].splitlines(keepends=True)
            cells[-1]["outputs"] = [{"name": "stdout", "output_type": "stream", "text": lines}]
        else:
            body = match["body"]
            if match["title"] is not None:
                body = f"%%writefile {match['title']}\n{body}"
            elif match["language"] == "sh":
                body = re.sub(r"^mgs ", '!"{sys.executable}" -m mgs ', body, flags=re.MULTILINE)
                body = re.sub(r"^python ", '!"{sys.executable}" ', body, flags=re.MULTILINE)
                body = "import sys\n\n" + body
            add("code", body, execution_count=None, outputs=[])
        end = match.end()
    add("markdown", page[end:])
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    book = {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(book, indent=1, ensure_ascii=False) + "\n"


def main(arguments: list[str]) -> int:
    """Run the tutorial; with --write also renew its output. Returns the exit code."""
    with tempfile.TemporaryDirectory() as folder:
        page, differences = run_page(TUTORIAL, Path(folder))
        if "--write" in arguments:
            TUTORIAL.write_text(page, encoding="utf-8")
            for made in NOTEBOOKS:
                text = notebook(made.read_text(encoding="utf-8"))
                made.with_suffix(".ipynb").write_text(text, encoding="utf-8")
            for source, name in PICTURES.items():
                shutil.copyfile(Path(folder) / source, ROOT / "docs/images" / name)
            return 0
    print("\n".join(differences) or "the tutorial prints what it shows")
    return int(bool(differences))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
