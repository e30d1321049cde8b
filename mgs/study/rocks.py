"""Rocks of the studies of policies."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mgs.study.case import Scene

MESH_SCENE = "boulder"
"""Scene whose ground, light and orbits a mesh gets."""


@dataclass(frozen=True)
class Rock:
    """A scene and the seed of its rock, or a mesh file and its hash in MESH_SCENE. index: place
    among the rocks, and seed of the runs."""

    scene: str
    seed: int
    index: int = 0
    mesh: Path | None = None
    digest: str = ""

    @property
    def name(self) -> str:
        """Folder name."""
        return f"{self.scene}-{self.digest[:8] if self.mesh else self.seed}"

    def at(self, orbit: dict[str, Any]) -> Scene:
        """Scene of the rock with values of the orbit's section."""
        scene = MESH_SCENE if self.mesh else self.scene
        mesh = str(self.mesh) if self.mesh else None
        kind = "-".join([orbit["kind"], *map(str, orbit.get("distances", ()))])
        return Scene(scene, self.seed, {"orbit": orbit}, mesh, f"{self.name}/{kind}")


_SEEDS = {
    "boulder": (11, 12),
    "contact-binary": (12, 14),
    "low-sun": (11, 12),
    "pebbles": (11, 12),
    "strata": (12,),
    "horseshoe": (11,),
    "obsidian": (12,),
    "half-banded": (11,),
}

FRESH = tuple(
    Rock(scene, seed, index)
    for index, (scene, seed) in enumerate(
        (scene, seeds[k]) for k in range(2) for scene, seeds in _SEEDS.items() if k < len(seeds)
    )
)
"""Rocks that chose no setting: of each scene the first seeds from 11 on with which the rock is
wholly in every view, one of each scene first. Three scenes are new with them."""
