"""Tables of measured numbers in README.md and docs/*.md, made from docs/benchmarks/*.json and
docs/results/*/*.json.

    python tools/tables.py            # write them anew
    python tools/tables.py --check    # exit code 1 where one is not what its numbers say

A table stands between `<!-- table: NAME -->` and `<!-- end of table -->`; NAME is a key of
`TABLES`, whose rows are in tools/table_makers.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from table_makers import benchmarks, core, fits, studies
from table_makers.studies import NOT_RUN

ROOT = Path(__file__).parent.parent
MARK = re.compile(r"<!-- (?:table: (?P<name>\S+)|end of table) -->")
TABLES = benchmarks.TABLES | core.TABLES | fits.TABLES | studies.TABLES


def rewritten(page: str, docs: Path) -> str:
    """A page with its tables made anew; docs: the folder of their numbers.

    Raises ValueError where a mark has no partner, or a table is unknown.
    """
    parts, end = [], 0
    marks = list(MARK.finditer(page))
    for opening, closing in zip(marks[::2], marks[1::2], strict=False):
        name = opening["name"]
        if name is None or closing["name"] is not None:
            raise ValueError(
                f"{opening[0]}, {closing[0]}: marks must come in pairs, `table: NAME` and `end of table`"
            )
        if name not in TABLES:
            raise ValueError(
                f"{opening[0]}: no such table; tools/tables.py has {', '.join(TABLES)}"
            )
        file, make = TABLES[name]
        path = docs / f"{file}.json"
        missing = file in NOT_RUN and not path.is_file()
        table = NOT_RUN[file] if missing else make(json.loads(path.read_text(encoding="utf-8")))
        parts += [page[end : opening.end()], f"\n\n{table}\n"]
        end = closing.start()
    if len(marks) % 2:
        raise ValueError(f"{marks[-1][0]}: has no partner")
    return "".join([*parts, page[end:]])


def main(arguments: Sequence[str], root: Path = ROOT) -> int:
    """Rewrite the pages, or with --check only name those that are stale. Returns the exit code."""
    stale = 0
    for path in (root / "README.md", *sorted((root / "docs").rglob("*.md"))):
        page = path.read_text(encoding="utf-8")
        try:
            new = rewritten(page, root / "docs")
        except ValueError as error:
            print(f"{path.relative_to(root)}: {error}", file=sys.stderr)
            return 2
        if new == page:
            continue
        stale += 1
        if "--check" in arguments:
            print(
                f"{path.relative_to(root)}: a table is stale; run `python tools/tables.py`",
                file=sys.stderr,
            )
        else:
            path.write_text(new, encoding="utf-8")
            print(f"wrote {path.relative_to(root)}")
    return int("--check" in arguments and stale > 0)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
