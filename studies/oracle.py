"""Policies beside `studies.policies.Oracle`, which sees the truth."""

from argparse import Namespace
from dataclasses import replace

from studies import setups
from studies.frame.program import study_of


def sized(size: setups.SetupSize, options: Namespace) -> setups.SetupSize:
    """As in the set-ups, with two rocks by default."""
    return setups.sized(replace(size, count=2), options)


STUDY = replace(
    setups.STUDY,
    name="oracle",
    about="Compare policies as `setups` does, with an oracle that chooses the view which raises "
    "the PSNR of the test views most: an upper bound for policies, which cannot see test views.",
    cells=lambda size: [*setups.cells_of(size), *setups.cells_of(size, (setups.ORACLE,))],
    sized=sized,
)

if __name__ == "__main__":
    study_of("oracle")()
