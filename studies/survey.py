"""Policies compared with the poses, depth and prior of `mgs survey`: see `studies.setups`."""

from dataclasses import replace

from studies import setups
from studies.frame.program import study_of

tables = setups.tables

STUDY = replace(
    setups.STUDY,
    name="survey",
    about="Compare policies as `setups` does, with the poses, depth and prior of `mgs survey`.",
    cells=lambda size: setups.cells_of(size, setups=setups.SURVEYED),
    write=lambda work: setups.write(work, "survey", work.cells),
)

if __name__ == "__main__":
    study_of("survey")()
