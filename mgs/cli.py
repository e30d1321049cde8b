"""The `mgs` command. One file per command in `mgs/commands`; heavy imports stay inside the commands."""

from __future__ import annotations

import sys

import typer

from mgs.commands import COMMANDS
from mgs.errors import InputError

INTERRUPTED = 130
"""Exit code after Ctrl-C: 128 + SIGINT."""

app = typer.Typer(
    name="mgs",
    help="Active Gaussian splatting: exact Fisher information and next-best-view selection.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for name, command in COMMANDS.items():
    app.command(name)(command)


def main(arguments: list[str] | None = None) -> None:
    """Run a command: bad input is one line and exit code 2, an interruption is one line and exit code 130."""
    try:
        app(arguments, standalone_mode=True)
    except InputError as error:
        print(f"mgs: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except SystemExit as stop:
        if stop.code == INTERRUPTED:  # typer has turned Ctrl-C into this, without a word
            print("mgs: interrupted; what was finished is kept", file=sys.stderr)
        raise


if __name__ == "__main__":
    main()
