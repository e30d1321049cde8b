"""Policies compared with the poses, depth and prior of `mgs survey`: see `studies.setups`."""

from studies.commands import start

if __name__ == "__main__":
    start("survey")
