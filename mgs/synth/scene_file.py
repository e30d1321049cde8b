"""Scene files: one TOML per scene, validated. Lengths in metres, angles in degrees, linear RGB."""

from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mgs.errors import InputError
from mgs.files import read_json, read_toml
from mgs.resources import scene_path

Positive = Annotated[float, Field(ge=1e-6, le=1e6)]

Fraction = Annotated[float, Field(ge=0, le=1)]

Elevation = Annotated[float, Field(ge=0, le=90)]

OrbitKind = Literal["circle", "rings", "spiral", "hemisphere"]

Colour = tuple[Fraction, Fraction, Fraction]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Lobe(_Strict):
    """One ellipsoid of the rock's body, in any unit: the whole rock is scaled to its size."""

    centre: tuple[float, float, float] = (0, 0, 0)
    radii: tuple[Positive, Positive, Positive] = (1, 1, 1)


class Rock(_Strict):
    """The rock: body, weathering, colour."""

    size: Positive = 1.8  # longest side, metres; a mesh given by `mesh` is scaled to it too
    buried: Annotated[float, Field(ge=0, lt=1)] = 0.12  # share of its height below the ground
    lobes: Annotated[tuple[Lobe, ...], Field(min_length=1)] = (Lobe(radii=(1.0, 0.8, 0.72)),)
    facets: Annotated[int, Field(ge=0, le=1000)] = 16  # planes that cut each lobe
    relief: Fraction = 0.06  # amplitude of the coarsest displacement, as a share of the size
    cracks: Fraction = 0.012  # depth of cracks, as a share of the size
    layers: Annotated[int, Field(ge=0, le=1000)] = 0  # number of strata over the height; 0 for none
    plain_half: bool = False  # leave the half at negative x without albedo texture
    colours: tuple[Colour, Colour] = ((0.30, 0.24, 0.19), (0.14, 0.115, 0.10))  # light, dark
    dust: Colour = (0.42, 0.30, 0.20)  # dust on faces that look up
    specular: Fraction = 0.3  # of `principled` (Mitsuba): 0 for no reflection, 0.5 as of glass
    roughness: Annotated[float, Field(gt=0, le=1)] = 0.8  # width of it: smaller is sharper
    detail: Positive = 0.011  # length of a mesh edge, metres


class Arena(_Strict):
    """The ground: regolith with grain, undulation and small stones."""

    colour: Colour = (0.36, 0.26, 0.18)
    undulation: Annotated[float, Field(ge=0)] = 0.02  # amplitude near the rock, metres
    stones: Annotated[int, Field(ge=0, le=100_000)] = 700
    stone_size: Positive = 0.05  # median diameter, metres; a power law up to `largest_stone`
    largest_stone: Positive = 0.16
    spread: Positive = 12.0  # stones lie within this distance of the rock's axis, metres
    clearance: Positive = 1.15  # stones keep this far from the rock, as a multiple of its radius


class Sky(_Strict):
    """Sun and clear sky (Hosek-Wilkie, Mitsuba's `sunsky`)."""

    sun_elevation: Annotated[float, Field(gt=0, le=90)] = 42
    sun_azimuth: float = 35  # counter-clockwise from +x
    turbidity: Annotated[float, Field(ge=1, le=10)] = 3.5
    sun_scale: Positive = 1.0
    sky_scale: Positive = 1.0


class Lens(_Strict):
    """The camera; the image size comes from the preset."""

    fov: Annotated[float, Field(gt=1, lt=150)] = 44  # horizontal field of view


class Orbit(_Strict):
    """Positions of the cameras, which all look at the middle of the rock."""

    kind: OrbitKind = "circle"
    radius: Positive = 4.0  # from the rock's axis (circle) or its middle (the others)
    altitude: Annotated[float, Field(ge=0)] = 2.3  # height above the ground (circle)
    elevations: tuple[Elevation, Elevation] = (12, 65)  # above the rock's middle (the others)
    turns: Positive = 3  # turns of the spiral, or number of rings
    # Factors on the distance from the middle, in turn: (1, 2, 3) mixes near and far views.
    distances: Annotated[tuple[Positive, ...], Field(min_length=1)] = (1,)


MOST_ERROR = 100.0  # largest factor on sensor errors: odometry then errs by as much as it moves


class Sensor(_Strict):
    """Errors of the sensors of `mgs survey`; `mgs synth-orbit` has none."""

    noise: Annotated[float, Field(ge=0, le=MOST_ERROR)] = 1.0  # factor on `survey.depth_sensor`
    drift: Annotated[float, Field(ge=0, le=MOST_ERROR)] = 1.0  # factor on `survey.registration`


class SceneFile(_Strict):
    """A scene: rock, arena, sun and sky, camera, orbit, sensor noise."""

    description: str = ""
    rock: Rock = Rock()
    arena: Arena = Arena()
    sky: Sky = Sky()
    camera: Lens = Lens()
    orbit: Orbit = Orbit()
    sensor: Sensor = Sensor()


def load_scene_file(scene: str | Path, **orbit: Any) -> SceneFile:
    """Read a scene by its name (`boulder`) or path (`my.toml`). orbit: values of its orbit that
    replace those of the file. Raises InputError if it does not exist, is not TOML, or has an
    unknown key or a value out of range."""
    path = scene_path(scene)
    data = read_toml(path)
    try:
        settings = SceneFile.model_validate(data)
        values = settings.orbit.model_dump() | orbit
        return settings.model_copy(update={"orbit": Orbit.model_validate(values)})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            keys = ", ".join(_keys_beside(first["loc"]))
            raise InputError(f"{path}: unknown key {key!r}; choose one of {keys}") from None
        why = f"{key}: {first['msg']} (is {repr(first['input'])[:80]})"
        raise InputError(f"{path}: {why}; correct it") from None


def _keys_beside(where: tuple[int | str, ...]) -> list[str]:
    """Keys allowed beside the key at `where`, a path such as ("rock", "lobes", 0, "radius")."""
    section: Any = SceneFile
    for part in where[:-1]:
        if isinstance(part, str):  # a number is an index into a list of one kind
            kind = section.model_fields[part].annotation
            section = next(iter(get_args(kind)), kind)
    return list(section.model_fields)


def sensor_of(dataset: Path) -> Sensor:
    """Sensor settings of the scene that a dataset was rendered from; defaults without config.json.
    Raises InputError if config.json is damaged."""
    path = dataset / "config.json"
    recorded = read_json(path) if path.is_file() else {}
    try:
        return Sensor.model_validate(recorded.get("scene", {}).get("sensor", {}))
    except (ValidationError, AttributeError):
        cure = "correct it or give `sensor_noise` and `drift`"
        raise InputError(f"{path}: its scene.sensor is damaged; {cure}") from None
