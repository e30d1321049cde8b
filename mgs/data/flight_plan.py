"""Flight plans for a drone: QGroundControl's .plan ("Plan File Format"), MAVLink's .waypoints
(common message set), and KML (OGC 2.3). The world's +Z is up; by default +X is east and +Y
north."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from mgs.camera import Camera, heading_and_pitch
from mgs.errors import InputError, printable
from mgs.files import atomic_path, write_json

EQUATOR, FLATTENING = 6378137.0, 1 / 298.257223563  # WGS 84: radius, metres, and flattening
HIGHEST = 1e5  # largest height of an origin above or below the sea, metres
# MAVLink commands: NAV_WAYPOINT, NAV_RETURN_TO_LAUNCH, NAV_TAKEOFF, DO_CHANGE_SPEED,
# DO_MOUNT_CONTROL, IMAGE_START_CAPTURE.
WAYPOINT, HOME, TAKEOFF, SPEED, MOUNT, PICTURE = 16, 20, 22, 178, 205, 2000
GLOBAL_RELATIVE, MISSION = 3, 2  # MAVLink frames: altitude above home; no position
MAVLINK_TARGETING = 2  # mode of the mount: angles from the mission
KML = "http://www.opengis.net/kml/2.2"


@dataclass(frozen=True)
class Origin:
    """Place of the world's origin, degrees and metres.

    bearing: of the level part of the world's +Y (of +Z where +Y is steep), degrees clockwise from
    north. Positions have +Z up and that direction as +Y (`mgs.data.world.World`)."""

    latitude: float
    longitude: float
    altitude: float
    bearing: float = 0.0

    def geodetic(self, position: np.ndarray) -> tuple[float, float, float]:
        """Latitude, longitude (degrees) and altitude (metres) of a world position [3]. By the
        ellipsoid's radii of curvature at the origin: exact to a centimetre within 500 m."""
        x, y, z = (float(value) for value in position)
        turn, lat = math.radians(self.bearing), math.radians(self.latitude)
        east = x * math.cos(turn) + y * math.sin(turn)
        north = y * math.cos(turn) - x * math.sin(turn)
        eccentricity = FLATTENING * (2 - FLATTENING)
        root = 1 - eccentricity * math.sin(lat) ** 2
        across = EQUATOR / math.sqrt(root)
        along = EQUATOR * (1 - eccentricity) / root**1.5
        return (
            self.latitude + math.degrees(north / (along + self.altitude)),
            self.longitude + math.degrees(east / ((across + self.altitude) * math.cos(lat))),
            self.altitude + z,
        )


def parse_origin(text: str) -> Origin:
    """The origin of an option like 47.1,8.2,430 or 47.1,8.2,430,90. Raises InputError."""
    try:
        origin = Origin(*(float(part) for part in text.split(",")))
        good = all(math.isfinite(value) for value in vars(origin).values())
        if not good or abs(origin.latitude) > 85 or abs(origin.longitude) > 180:
            raise ValueError
        if abs(origin.altitude) > HIGHEST:
            raise ValueError
    except (TypeError, ValueError):
        raise InputError(
            f"origin {text!r}: expected LATITUDE,LONGITUDE,ALTITUDE, and optionally the bearing "
            "of the world's +Y, in degrees and metres"
        ) from None
    return origin


@dataclass(frozen=True)
class Stop:
    """A place to fly to. position: [3], +Z up, metres. camera: of the picture to take there, in the
    same world; None: no picture."""

    position: np.ndarray
    name: str = ""
    camera: Camera | None = None

    def heading_and_pitch(self, bearing: float) -> tuple[float, float]:
        """Heading clockwise from north, and pitch of the camera above the horizon, degrees."""
        assert self.camera is not None
        heading, pitch = heading_and_pitch(self.camera)
        return (heading + bearing) % 360, pitch


def check_plan_path(path: Path) -> None:
    """Raise InputError if no flight plan is written with this suffix."""
    if path.suffix.lower() not in WRITERS:
        cure = "choose another ending"
        raise InputError(f"plan {path}: flight plans are written as {', '.join(WRITERS)}; {cure}")


def write_flight_plan(
    path: str | Path, stops: Sequence[Stop], origin: Origin, hover: float, speed: float
) -> None:
    """Write a flight plan in the format of its suffix (WRITERS), atomically. The first stop is the
    home on the ground, where the flight starts and ends. hover: seconds at each picture; speed:
    metres per second. Raises InputError as `check_plan_path` and `atomic_path`."""
    check_plan_path(Path(path))
    WRITERS[Path(path).suffix.lower()](Path(path), stops, origin, hover, speed)


def _items(stops: Sequence[Stop], origin: Origin, hover: float, speed: float) -> list[list[Any]]:
    """Mission items: command, frame, and seven parameters; the last three are a position. Altitudes
    are above home, the first stop. The drone rises there to the height of the next one."""
    lat, lon, ground = origin.geodetic(stops[0].position)
    rise = float(stops[1].position[2] - stops[0].position[2])
    items: list[list[Any]] = [
        [TAKEOFF, GLOBAL_RELATIVE, 0, 0, 0, 0, lat, lon, rise],
        [SPEED, MISSION, 1, speed, -1, 0, 0, 0, 0],
    ]
    for stop in stops[1:]:
        lat, lon, alt = origin.geodetic(stop.position)
        heading, pitch, hold = 0.0, 0.0, 0.0
        if stop.camera is not None:
            (heading, pitch), hold = stop.heading_and_pitch(origin.bearing), hover
        items.append([WAYPOINT, GLOBAL_RELATIVE, hold, 0, 0, heading, lat, lon, alt - ground])
        if stop.camera is not None:
            items.append([MOUNT, MISSION, pitch, 0, 0, 0, 0, 0, MAVLINK_TARGETING])
            items.append([PICTURE, MISSION, 0, 0, 1, 0, 0, 0, 0])
    return [*items, [HOME, MISSION, 0, 0, 0, 0, 0, 0, 0]]


def _write_plan(
    path: Path, stops: Sequence[Stop], origin: Origin, hover: float, speed: float
) -> None:
    items = [
        {
            "type": "SimpleItem",
            "autoContinue": True,
            "doJumpId": number,
            "command": command,
            "frame": frame,
            "params": params,
        }
        for number, (command, frame, *params) in enumerate(_items(stops, origin, hover, speed), 1)
    ]
    mission = {
        "version": 2,
        "firmwareType": 12,  # PX4; commands are those that ArduPilot shares
        "vehicleType": 2,  # multicopter
        "cruiseSpeed": speed,
        "hoverSpeed": speed,
        "plannedHomePosition": list(origin.geodetic(stops[0].position)),
        "items": items,
    }
    none = {"version": 2, "circles": [], "polygons": []}
    plan = {"fileType": "Plan", "version": 1, "groundStation": "QGroundControl"}
    rally = {"version": 2, "points": []}
    write_json(path, plan | {"mission": mission, "geoFence": none, "rallyPoints": rally})


def _write_waypoints(
    path: Path, stops: Sequence[Stop], origin: Origin, hover: float, speed: float
) -> None:
    """Write "QGC WPL 110": a line for home, then one for each mission item."""
    home = [WAYPOINT, 0, 0, 0, 0, 0, *origin.geodetic(stops[0].position)]
    lines = ["QGC WPL 110"]
    for number, item in enumerate([home, *_items(stops, origin, hover, speed)]):
        command, frame, *params = item
        numbers = "\t".join(f"{value:.8f}" for value in params)
        lines.append(f"{number}\t{int(number == 0)}\t{frame}\t{command}\t{numbers}\t1")
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="ascii")


def _write_kml(
    path: Path, stops: Sequence[Stop], origin: Origin, hover: float, speed: float
) -> None:
    """Write the way as a line, and each picture as a place with its camera."""
    ElementTree.register_namespace("", KML)
    root = ElementTree.Element(f"{{{KML}}}kml")
    document = _add(root, "Document")

    def coordinates(stop: Stop) -> str:
        lat, lon, alt = origin.geodetic(stop.position)
        return f"{lon:.9f},{lat:.9f},{alt:.3f}"

    for stop in stops:
        if stop.camera is None:
            continue
        place = _add(document, "Placemark")
        _add(place, "name", printable(stop.name))
        heading, pitch = stop.heading_and_pitch(origin.bearing)
        lat, lon, alt = origin.geodetic(stop.position)
        camera = _add(place, "Camera")
        values = {"longitude": lon, "latitude": lat, "altitude": alt, "heading": heading}
        for key, value in (values | {"tilt": 90 + pitch}).items():
            _add(camera, key, f"{value:.9f}")
        _add(camera, "altitudeMode", "absolute")
        point = _add(place, "Point")
        _add(point, "altitudeMode", "absolute")
        _add(point, "coordinates", coordinates(stop))
    way = _add(document, "Placemark")
    _add(way, "name", "way")
    line = _add(way, "LineString")
    _add(line, "altitudeMode", "absolute")
    _add(line, "coordinates", " ".join(coordinates(stop) for stop in [*stops, stops[0]]))
    with atomic_path(path) as temporary:
        ElementTree.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)


def _add(parent: ElementTree.Element, name: str, text: str = "") -> ElementTree.Element:
    element = ElementTree.SubElement(parent, f"{{{KML}}}{name}")
    element.text = text or None
    return element


WRITERS: dict[str, Callable[[Path, Sequence[Stop], Origin, float, float], None]] = {
    ".plan": _write_plan,
    ".waypoints": _write_waypoints,
    ".kml": _write_kml,
}
