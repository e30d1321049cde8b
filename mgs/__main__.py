"""`python -m mgs`."""

from mgs.cli.app import main

main()
