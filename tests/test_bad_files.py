"""Files that no reader accepts: one line that names the file and its fault, nothing printed."""

import gzip
import json
import os
import re
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from threading import Thread

import numpy as np
import OpenEXR
import pytest
import tiny
import trimesh
from refusals import fails
from test_fuzz import cloud, colmap, exr, mesh
from test_meshes import Made, coloured, glb, parts_of
from test_meshes import plain as square
from test_render_command import foreign_ply, gaussians

from mgs import PriorSettings, images, load_cameras, load_prior, prior_from_mesh
from mgs.data.clouds import read_cloud
from mgs.data.meshes import load_mesh, read_mesh
from mgs.data.sources import read_source
from mgs.files import read_csv, read_json, read_toml, read_xml
from mgs.images import read_exr, write_exr
from mgs.splat_files import load_gaussians, write_gaussians
from mgs.splat_ply import read_ply, write_compressed_ply
from mgs.synth.rock import load_rock
from mgs.synth.scene_file import Rock

Write = Callable[[Path], object]
XYZ = "".join(f"property float {name}\n" for name in "xyz")


def holding(content: str | bytes) -> Write:
    data = content if isinstance(content, bytes) else content.encode()
    return lambda path: path.write_bytes(data)


def spoilt(write: Write, change: Callable[[bytes], bytes]) -> Write:
    """Write a sound file, and change its bytes."""

    def make(path: Path) -> None:
        write(path)
        path.write_bytes(change(path.read_bytes()))

    return make


def replaced(write: Write, old: bytes, new: bytes) -> Write:
    return spoilt(write, lambda data: data.replace(old, new, 1))


def halved(write: Write) -> Write:
    """Cut a file in half, as a full disk does."""
    return spoilt(write, lambda data: data[: len(data) // 2])


def two_parts(path: Path) -> None:
    kind, grey = OpenEXR.scanlineimage, np.zeros((4, 4), np.float32)
    parts = [OpenEXR.Part({"type": kind}, {"Z": grey}, name) for name in "ab"]
    OpenEXR.File(parts).write(str(path))


def deep_exr(path: Path) -> None:
    pixels = np.empty((4, 4), object)
    pixels[:] = [[np.ones(row, np.float32) for row in range(4)] for _ in range(4)]
    header = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
    OpenEXR.File(header, {"Z": pixels}).write(str(path))


def flat_exr(path: Path) -> None:
    write_exr(path, {"Z": np.zeros((4, 4))})


def sampled(every: int) -> bytes:
    """The channel of `flat_exr` in the file's list of channels."""
    return b"Z\0" + struct.pack("<i4x2i", 2, every, every)


def window(*corners: int) -> bytes:
    return b"dataWindow\0box2i\0" + struct.pack("<5i", 16, *corners)


def endless_splats(path: Path) -> None:
    write_gaussians(path, gaussians(0), "glb", np.eye(3))
    endless_mesh(path, lambda path: path)


def endless_mesh(path: Path, write: Write = square) -> None:
    """A GLB file whose arrays are said to have 10^12 numbers."""
    write(path)
    content, body = parts_of(path)
    for one in content["accessors"]:
        del one["bufferView"]
        one["count"] = 10**12
    path.write_bytes(glb(content, body))


def names_a_pipe(path: Path) -> None:
    """It must not be opened, which would never end."""
    os.mkfifo(path.with_name("pipe.bin"))
    view = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
    content = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": "pipe.bin", "byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [view],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
    }
    path.write_text(json.dumps(content))


def archive(path: Path) -> None:
    (path.parent / "inside").mkdir()
    shutil.make_archive(str(path.with_suffix("")), "zip", path.parent / "inside")


def compressed_mesh(path: Path) -> None:
    """Its positions are in a buffer that a decoder would fill."""
    square(path)
    content, body = parts_of(path)
    view = content["bufferViews"][1]
    view |= {"buffer": 1, "extensions": {"EXT_meshopt_compression": {"buffer": 0}}}
    content["buffers"].append({"byteLength": 999})
    path.write_bytes(glb(content, body))


def corner(mode: int, **more: object) -> Write:
    """A GLB of four vertices in this mode."""

    def make(path: Path) -> None:
        made = Made()
        made.write(path, made.shape(np.eye(4, 3), mode), **more)

    return make


def ply_mesh(faces: int, last: str) -> Write:
    head = f"ply\nformat ascii 1.0\nelement vertex 4\n{XYZ}element face {faces}\n"
    head += "property list uchar int vertex_indices\nend_header\n"
    return holding(f"{head}0 0 0\n1 0 0\n0 1 0\n{last}\n")


def obj(*vertices: str) -> Write:
    return holding("".join(f"v {vertex}\n" for vertex in vertices) + "f 1 2 3\n")


def rock(path: Path) -> object:
    return load_rock(path, Rock())


def colmap_model(place: int, value: bytes, *without: str, end: int | None = None) -> Write:
    """A binary model with other bytes at a place of one file, or cut off; without some files."""

    def make(path: Path) -> None:
        colmap("binary")(path)
        for other in without:
            path.with_name(f"{other}.bin").unlink()
        data = path.read_bytes()
        path.write_bytes((data[:place] + value + data[place + len(value) :])[:end])

    return make


def in_folder(read: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda path: read(path.parent)


def prior_points(change: Callable[[bytes], bytes]) -> Write:
    return spoilt(lambda path: tiny.write_prior(path.parent), change)


def compressed(path: Path) -> None:
    model = gaussians(1, n=300)
    model.means[0] = 2.5
    write_compressed_ply(path, model)


def few(path: Path) -> None:
    foreign_ply(path, gaussians(0, n=3))


def spz(*head: int, rest: bytes = b"") -> Write:
    return holding(gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", *head, 0, 0) + rest))


def framed(path: str) -> Write:
    """A transforms.json without intrinsics and with one frame of this path."""
    frame = {"file_path": path, "transform_matrix": np.eye(4).tolist()}
    return holding(json.dumps({"frames": [frame]}))


def primitive(**values: object) -> Write:
    return holding(glb({"meshes": [{"primitives": [values]}]}))


ENDLESS = holding(f"ply\nformat ascii 1.0\nelement vertex 10000000000\n{XYZ}end_header\n0 0 0\n")
HUGE = "ply\nformat binary_little_endian 1.0\nelement vertex 9223372036854775808\n"
EMPTY = "ply\nformat ascii 1.0\nelement point 0\n"
ONE_FLOAT = "property float x\nend_header\n"
ENTITIES = b'<!DOCTYPE a [<!ENTITY b "c">' + b'<!ENTITY d "&b;">' * 3 + b"]><a>&d;</a>"
SPLATS = {"mode": 0, "attributes": {}, "extensions": {"KHR_gaussian_splatting": {}}}
PACKED = {"KHR_gaussian_splatting": {"extensions": {"KHR_spz": {}}}}
NAN, LARGEST = np.float32(np.nan).tobytes(), np.float32(2.5).tobytes()
NEEDED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "X_y")
EXTENSIONS = [(f"glTF extension {name}", corner(6, extensionsRequired=[name])) for name in NEEDED]
KTX = b"\xabKTX 20\xbb" + bytes(90)
COLMAP = ("cameras", "images", "points3D", "frames", "rigs")
BAD_IMAGES = (12, b"\0" * 32), (44, b"\0" * 6 + b"\xf0\x7f"), (68, b"\xff" * 4), (72, b"\n")
CUT_OFF = [("cut off", colmap_model(0, b"\xff" * 8)), ("cut off", colmap_model(0, b"", end=-9))]

FILES: dict[tuple[Callable[[Path], object], str], list[tuple[str, Write]]] = {
    (read_exr, "a.exr"): [
        ("not a readable EXR", halved(exr)),
        ("has 2 parts, which mgs does not read", two_parts),
        ("several samples in a pixel", deep_exr),
        ("has subsampled channels", replaced(flat_exr, sampled(1), sampled(2))),
        ("2097152x4 pixels", replaced(flat_exr, window(0, 0, 3, 3), window(0, 0, 2**21 - 1, 3))),
    ],
    (read_json, "a.json"): [
        ("GiB are free", lambda path: (path.touch(), os.truncate(path, 1 << 40))),
        ("not valid JSON", holding("[" * 100_000)),
        ("not valid JSON", holding('{"a": 1' + "0" * 5000 + "}")),
        ("has 33,554,434 bytes", holding("[]" + " " * (1 << 25))),
    ],
    (read_toml, "a.toml"): [
        ("not valid TOML", holding("a = " + "[" * 5000 + "]" * 5000)),
        ("not valid TOML", holding("a = 1" + "0" * 5000)),
        ("a line has more than", holding("a." * 5000 + "a = 1")),
    ],
    (read_csv, "a.csv"): [("not valid", holding("a," + "b" * 200_000))],
    (read_xml, "a.xml"): [("not valid", holding(ENTITIES)), ("not valid", holding("<a>" * 9))],
    (rock, "a.ply"): [
        ("no such mesh", lambda path: None),
        ("not a readable mesh", holding("ply\nformat nonsense")),
        ("has no faces", ply_mesh(0, "0 0 1")),
        ("vertex 3 is NaN", ply_mesh(1, "nan 0 0\n3 0 1 2")),
        ("names vertex 9 of 4", ply_mesh(1, "0 0 1\n3 0 1 9")),
        ("names vertex -1 of 4", ply_mesh(1, "0 0 1\n3 0 1 -1")),
    ],
    (rock, "a.obj"): [
        ("vertex 1 is NaN or infinite", obj("0 0 0", "inf 0 0", "0 1 0")),
        ("further than", obj("0 0 0", "1e200 0 0", "0 1e200 0")),
        ("none of its faces has an area", obj("0 0 0", "1 0 0", "2 0 0")),
        ("flat on the ground", obj("0 0 0", "1 0 0", "0 0 1")),
    ],
    (rock, "a.xyz9"): [("not a readable mesh", holding("1 2 3"))],
    (load_mesh, "a.zip"): [("not a readable mesh", archive)],
    (load_mesh, "a.gltf"): [("pipe.bin is no regular file", names_a_pipe)],
    (read_mesh, "a.glb"): [
        ("has no faces", trimesh.PointCloud(np.eye(3)).export),
        ("not points or lines", corner(3)),
        ("glTF extension EXT_meshopt_compression", compressed_mesh),
        ("a skin or morph targets", corner(6, nodes=[{"mesh": 0, "skin": 0}])),
        ("a skin or morph targets", corner(6, nodes=[{"mesh": 0, "weights": [0, 0.5]}])),
        *EXTENSIONS,
    ],
    (load_mesh, "a.glb"): [
        ("13300x13300 pixels", lambda path: mesh(path, 13_300)),
        ("GiB that are free", endless_mesh),
        ("KHR_texture_basisu", lambda path: coloured(path, texture=KTX, mime="image/ktx2")),
        *EXTENSIONS,
    ],
    (read_cloud, "a.ply"): [
        ("GiB that are free", ENDLESS),
        ("not a readable cloud", halved(cloud)),
    ],
    (in_folder(load_prior), "points.ply"): [
        ("early end-of-file", prior_points(lambda data: data[:500])),
        ("has NaN values", prior_points(lambda data: data[:-4] + NAN)),
    ],
    **{(in_folder(read_source), f"{name}.bin"): CUT_OFF for name in COLMAP},
    (in_folder(read_source), "images.bin"): [
        ("", colmap_model(place, value, "frames", "rigs"))  # else the poses are theirs
        for place, value in BAD_IMAGES
    ],
    (load_cameras, "a.json"): [
        ("frame 0 lacks file_path", holding('{"frames": [1]}')),
        ("frame 0 has a file_path that is no text or cannot be", framed("a\0b.png")),
    ],
    (load_gaussians, "a.ply"): [
        ("no such file; give a PLY", lambda path: None),
        ("not a readable 3DGS PLY", replaced(few, b"ply\n", b"solid ply\n")),
        ("property 'opacity' is missing", replaced(few, b"opacity", b"quality")),
        ("1 f_rest properties fit no SH degree", replaced(few, b"opacity", b"f_rest_0")),
        ("not a", replaced(few, b"float opacity", b"list uchar float opacity")),
        ("decoding it takes", replaced(few, b"vertex 3", b"vertex 2147483648")),
        ("not a readable 3DGS PLY", holding(HUGE + ONE_FLOAT)),
        ("it has no vertices", holding(EMPTY + ONE_FLOAT)),
        ("usable 'min_x'", replaced(compressed, b"element chunk", b"element other")),
        ("usable 'max_g'", replaced(compressed, b"max_g", b"max_q")),
        ("usable 'packed_scale'", replaced(compressed, b"uint packed_s", b"float packed_s")),
        ("1 chunks are too few", replaced(compressed, b"element chunk 2", b"element chunk 1")),
        ("'sh' is not 300 rows", replaced(compressed, b"element sh 300", b"element sh 299")),
        ("not a readable 3DGS PLY", replaced(compressed, b"element sh 300", b"element sh 301")),
    ],
    (read_ply, "a.ply"): [
        ("GiB that are free", ENDLESS),
        ("means is NaN or infinite", replaced(compressed, LARGEST, NAN)),
    ],
    (load_gaussians, "a.ksplat"): [("npx @playcanvas/splat-transform", holding(b"\0" * 64))],
    (load_gaussians, "a.glb"): [
        ("not a readable GLB", holding("glTF")),
        ("GiB that are free", endless_splats),
        ("not a readable GLB", holding(glb([]))),
        ("no Gaussians in it", primitive()),
        ("not a readable GLB", primitive(**SPLATS)),
        ("its Gaussians are compressed (KHR_spz)", primitive(**SPLATS | {"extensions": PACKED})),
    ],
    (load_gaussians, "a.spz"): [
        ("not a readable SPZ", holding(gzip.compress(b"NGSP\3\0\0\0\xff\xff\0\0"))),
        ("readable SPZ", spz(1, 9, 0, 12)),
        ("not a readable SPZ", spz(3, 10**9, 3, 12, rest=b"\0" * 99)),
        ("it is cut off", halved(spz(3, 10, 0, 12, rest=bytes(range(200))))),
    ],
}
"""Reader and name of a file -> words of the line, and how the file is made."""
ROWS = [(*to, *row) for to, rows in FILES.items() for row in rows]


@pytest.mark.parametrize(
    ("read", "name", "words", "make"), ROWS, ids=[" ".join(row[1:3]) for row in ROWS]
)
def test_a_file_that_cannot_be_read_is_one_line(tmp_path, capfd, read, name, words, make):
    if name.endswith("spz"):
        pytest.importorskip("gsply_cpp")
    make(tmp_path / name)
    assert str(tmp_path) in fails(re.escape(words), read, tmp_path / name)
    assert capfd.readouterr() == ("", "")


def test_what_is_hidden_in_one_thread_is_not_in_others(capsys):
    with images._silent():
        other = Thread(target=print, args=("progress",))
        other.start()
        other.join()
        print("noise of a library")
    assert capsys.readouterr().out == "progress\n"


def test_samples_finer_than_single_precision_are_refused(tmp_path):
    obj("1e6 0 0", "1000001 0 0", "1e6 1 0")(tmp_path / "a.obj")
    fails("float32", prior_from_mesh, tmp_path / "a.obj", PriorSettings(gaussians=100))
