"""The program `mgs`, and `python -m mgs`: end with one line where Ctrl-C comes during the start."""

import os
import sys
import warnings


def main() -> None:
    """Run `mgs.cli.app.main`. Raises SystemExit. Warnings of libraries are printed with python -W
    only."""
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # products are small: threads only wait
    try:
        from mgs.cli.app import main as run

        run()
    except BaseException as error:
        from mgs.errors import from_interrupt

        if isinstance(error, SystemExit) or not from_interrupt(error):
            raise
        print("mgs: interrupted", file=sys.stderr)
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
