"""Meshes of any kind: the right shape, colours and prior; glTF in every form that it has."""

import io
import json
import struct

import numpy as np
import pytest
import synthetic
import trimesh
from PIL import Image
from program import command, output
from refusals import fails

from mgs import Dataset, InputError, PriorSettings, load_prior, prior_from_mesh
from mgs.colour import linear_from_srgb, srgb_from_linear
from mgs.data import meshes
from mgs.data.meshes import Mesh, load_mesh, read_mesh, to_glb
from mgs.prior.surface import sample_surface


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return synthetic.write_dataset(tmp_path_factory.mktemp("meshes") / "data")


def test_a_plain_ply_is_read_as_trimesh_reads_it(tmp_path, monkeypatch):
    path, ball = tmp_path / "a.ply", trimesh.creation.icosphere(subdivisions=2)
    vertices, faces = ball.vertices + 0.1, np.vstack([ball.faces, ball.faces[:3, ::-1]])

    def write(vertices, faces):
        trimesh.Trimesh(vertices, faces, process=False).export(path)

    write(vertices, faces)
    assert meshes._plain_ply(path)
    fast = read_mesh(path)
    with monkeypatch.context() as patch:
        patch.setattr(meshes, "_plain_ply", lambda path: None)
        slow = read_mesh(path)
    for name in ("vertices", "faces", "seen"):
        assert np.array_equal(getattr(fast, name), getattr(slow, name))
    write(vertices, faces + 1)
    fails("names vertex", read_mesh, path)
    write(np.where(vertices > 1, np.nan, vertices), faces)
    fails("is NaN", read_mesh, path)
    path.write_bytes(path.read_bytes()[:-1])
    fails("not a readable mesh", read_mesh, path)


def test_the_prior_of_a_glb_stands_upright(dataset, tmp_path, capsys):
    options = ["--mesh", dataset.root / "rock.glb", "--gaussians", 100, "--out", tmp_path / "p"]
    assert "turned from +Y up" in output(capsys, "prior", dataset.root, *options)
    assert np.abs(synthetic.level(load_prior(tmp_path / "p").points)).max() < 0.01


def _spoilt() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Vertices and faces of the rock with defects that can be mended."""
    mesh = synthetic.rock_mesh()
    v, f = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    some = np.random.default_rng(0).random(len(f))[:, None] < 0.3
    turned, n = f[:, ::-1], len(v)
    own = np.arange(f.size).reshape(-1, 3)
    no_area = [[0, 0, 0], [3, 3, 5], [0, 1, n]]
    both = np.concatenate
    return {
        "faces twice, the second time inside out": (v, both([f, turned])),
        "all of it twice, with vertices of its own": (both([v, v]), both([f, turned + n])),
        "faces without area": (both([v, (v[:1] + v[1:2]) / 2]), both([no_area, f])),
        "vertices of no face": (both([[[900.0, 0, 0]], v]), f + 1),
        "inside out": (v, turned),
        "some faces inside out": (v, np.where(some, turned, f)),
        "no vertex shared": (v[f].reshape(-1, 3), np.where(some, own[:, ::-1], own)),
    }


SPOILT = _spoilt()


@pytest.mark.parametrize("how", SPOILT)
def test_a_mesh_that_can_be_mended_gives_the_same_prior(tmp_path, how):
    synthetic.rock_mesh().export(tmp_path / "rock.ply")
    trimesh.Trimesh(*SPOILT[how], process=False).export(tmp_path / "spoilt.ply")
    settings = PriorSettings(gaussians=200, backing=0)
    paths = tmp_path / "rock.ply", tmp_path / "spoilt.ply"
    right, found = (prior_from_mesh(path, settings) for path in paths)
    assert len(found.mesh.vertices) == len(right.mesh.vertices) or how.endswith("shared")
    assert len(found.mesh.faces) == len(right.mesh.faces)
    assert found.spacing == pytest.approx(right.spacing)
    outward = (found.points - synthetic.CENTRE) / synthetic.AXES**2
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert (np.einsum("nk,nk->n", outward, found.normals) > 0.99).all()
    # How evenly they lie tells whether a part has more than its share.
    octant = np.unique((found.points > synthetic.CENTRE) @ [1, 2, 4], return_counts=True)[1]
    assert octant.min() > 15


def test_a_single_triangle_and_a_fold_are_sampled(dataset, tmp_path):
    (tmp_path / "one.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 3 2\n")
    options = ["--mesh", tmp_path / "one.obj", "--gaussians", 40, "--out", tmp_path / "p"]
    command("prior", dataset.root, *options)
    # As it is wound, and drawn though no face is towards the viewer.
    assert np.allclose(load_prior(tmp_path / "p").normals, [0, 0, -1])
    # Two triangles folded flat onto each other: the normals of their vertices cancel.
    corners, faces = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 1]])
    normals = sample_surface(Mesh(corners, faces, np.ones(2, bool)), 0, count=40)[1]
    assert np.allclose(np.abs(normals), [0, 0, 1])


QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
FLOAT, BYTE, SHORT, USHORT, UINT = 5126, 5120, 5122, 5123, 5125
RED, GREEN = (200, 60, 60), (60, 170, 60)


def glb(content: object, body: bytes = b"") -> bytes:
    """A GLB of this JSON and binary chunk."""
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    body += b"\0" * (-len(body) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(body), 0x004E4942) + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def parts_of(path):
    """JSON and binary chunk of a GLB."""
    data = path.read_bytes()
    size = struct.unpack("<I", data[12:16])[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


class Made:
    """A GLB in the making: one node with the mesh of the primitives."""

    def __init__(self):
        self.body, self.json = b"", {"asset": {"version": "2.0"}, "bufferViews": []}
        self.json |= {"accessors": [], "nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}]}

    def view(self, data: bytes) -> int:
        self.body += b"\0" * (-len(self.body) % 4)
        place = {"buffer": 0, "byteOffset": len(self.body), "byteLength": len(data)}
        self.json["bufferViews"].append(place)
        self.body += data
        return len(self.json["bufferViews"]) - 1

    def add(self, values: np.ndarray, component: int = FLOAT, **more) -> int:
        dtype = {FLOAT: "<f4", BYTE: "i1", SHORT: "<i2", USHORT: "<u2", UINT: "<u4"}[component]
        kind = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[values[0].size]
        made = {"componentType": component, "count": len(values), "type": kind} | more
        if "sparse" not in more:
            made["bufferView"] = self.view(values.astype(dtype).tobytes())
        self.json["accessors"].append(made)
        return len(self.json["accessors"]) - 1

    def shape(self, points: np.ndarray, mode: int = 6, **more) -> dict:
        """A primitive of these points, by default a fan."""
        return {"attributes": {"POSITION": self.add(points)}, "mode": mode} | more

    def write(self, path, *primitives, **more):
        content = self.json | {"meshes": [{"primitives": list(primitives)}], **more}
        content["buffers"] = [{"byteLength": len(self.body)}]
        path.write_bytes(glb(content, self.body))
        return path


def plain(path):
    made = Made()
    faces = made.add(np.array([0, 1, 2, 0, 2, 3]), UINT)
    return made.write(path, made.shape(QUAD, 4, indices=faces))


def fan(path):
    made = Made()
    return made.write(path, made.shape(QUAD))


def strip_beside_a_line(path):
    made = Made()
    return made.write(path, made.shape(9 * QUAD, 1), made.shape(QUAD[[1, 2, 0, 3]], 5))


def sparse(path):
    made = Made()
    where = {"bufferView": made.view(np.array([1, 2, 3], "<u4").tobytes()), "componentType": UINT}
    values = {"bufferView": made.view(QUAD[1:].tobytes())}
    few = made.add(QUAD, sparse={"count": 3, "indices": where, "values": values})
    return made.write(path, {"attributes": {"POSITION": few}, "mode": 6})


def quantised(path, component=SHORT, most=32767):
    """As gltfpack: whole numbers with padding, scaled and shifted by the node."""
    made = Made()
    rows = np.zeros((4, 4))
    rows[:, :3] = np.round((QUAD - [0.5, 0.5, 0]) / 0.5 * most)
    made.add(rows, component, type="VEC3", normalized=True)
    made.json["bufferViews"][0]["byteStride"] = len(made.body) // 4
    made.json["nodes"][0] |= {"scale": [0.5] * 3, "translation": [0.5, 0.5, 0]}
    needs = {"extensionsRequired": ["KHR_mesh_quantization"]}
    return made.write(path, {"attributes": {"POSITION": 0}, "mode": 6}, **needs)


def nested(path):
    """A node below a turned, scaled and mirrored one."""
    made = Made()
    turn = {"rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)], "scale": [-2, 2, 2], "children": [1]}
    back = {"rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)], "scale": [0.5, -0.5, 0.5], "mesh": 0}
    return made.write(path, made.shape(QUAD), nodes=[turn, back])


FORMS = [plain, fan, strip_beside_a_line, sparse, quantised, nested]
FORMS.append(lambda path: quantised(path, BYTE, 127))


@pytest.mark.parametrize("form", FORMS)
def test_a_square_in_every_form(tmp_path, form):
    mesh = load_mesh(form(tmp_path / "x.glb"))
    flipped = np.sign(mesh.vertices @ [1, 0, 0]).sum() < 0  # the nested one is turned to -x
    assert mesh.area == pytest.approx(1, abs=1e-4)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [1, 1, 0], atol=1e-4)
    if not flipped:
        np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [1, 1, 0]], atol=1e-4)
        np.testing.assert_allclose(mesh.face_normals, [[0, 0, 1]] * 2, atol=1e-6)


def test_instances_and_mirrored_nodes(tmp_path):
    made = Made()
    where = {"TRANSLATION": made.add(np.array([[0, 0, 0], [5.0, 0, 0]]))}
    node = {"mesh": 0, "scale": [1, 1, -1]}
    node["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": where}}
    given = {"POSITION": made.add(QUAD), "NORMAL": made.add(0 * QUAD + [0, 0, 1])}
    primitive = {"attributes": given}
    mesh = load_mesh(made.write(tmp_path / "x.glb", primitive | {"mode": 6}, nodes=[node]))
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [6, 1, 0]])
    np.testing.assert_allclose(mesh.face_normals, [[0, 0, -1]] * 4)
    np.testing.assert_allclose(mesh.vertex_normals, [[0, 0, -1]] * 8)


def halves(left, right) -> bytes:
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[:, :4], pixels[:, 4:] = left, right
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def coloured(path, factor=None, texture=None, transform=None, colours=None, mime="image/png"):
    """A square with a material; `texture`: bytes of its image."""
    made = Made()
    given = {"POSITION": made.add(QUAD), "TEXCOORD_0": made.add(UV)}
    pbr, more = {}, {}
    if colours is not None:
        given["COLOR_0"] = made.add(colours, USHORT, normalized=True)
    if factor is not None:
        pbr["baseColorFactor"] = [*factor, 1]
    if texture is not None:
        more["images"] = [{"bufferView": made.view(texture), "mimeType": mime}]
        more["textures"] = [{"source": 0}]
        pbr["baseColorTexture"] = {"index": 0}
        if mime == "image/ktx2":
            more["textures"] = [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]
        if transform:
            pbr["baseColorTexture"]["extensions"] = {"KHR_texture_transform": transform}
    primitive = {"attributes": given, "mode": 6, "material": 0}
    return made.write(path, primitive, materials=[{"pbrMetallicRoughness": pbr}], **more)


def colour_at(mesh: trimesh.Trimesh, u: float, v: float = 0.5) -> np.ndarray:
    """Colour, sRGB 0 to 255, in the plane of the square."""
    weights = np.array([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v])
    if mesh.visual.kind == "vertex":
        return weights @ mesh.visual.vertex_colors[:, :3]
    x, y = weights @ (mesh.visual.uv * [1, -1] + [0, 1])
    image = mesh.visual.material.baseColorTexture
    return np.array(image.getpixel((int(8 * x // 1) % 8, int(8 * y // 1) % 8)))


def test_colours_of_a_material(tmp_path):
    """Factors and colours of vertices are linear, textures are sRGB."""
    half, image = (0.5, 1, 0.25), halves(GREEN, RED)
    path = tmp_path / "x.glb"
    factor = load_mesh(coloured(path, factor=half))
    np.testing.assert_allclose(colour_at(factor, 0.3), 255 * srgb_from_linear(half), atol=0.51)
    product = load_mesh(coloured(path, factor=half, texture=image))
    expected = 255 * srgb_from_linear(linear_from_srgb(np.divide(RED, 255)) * half)
    np.testing.assert_allclose(colour_at(product, 0.8), expected, atol=0.51)
    file = io.BytesIO()
    Image.fromarray(np.full((8, 8), 40_000, np.uint16)).save(file, "PNG")
    grey = load_mesh(coloured(path, texture=file.getvalue()))
    np.testing.assert_allclose(colour_at(grey, 0.3), 40_000 / 257, atol=0.51)
    rows = np.tile(np.round(65535 * linear_from_srgb(np.divide(RED, 255))), (4, 1))
    vertices = load_mesh(coloured(path, colours=np.column_stack([rows, [65535] * 4])))
    np.testing.assert_allclose(colour_at(vertices, 0.3), RED, atol=0.51)
    vertices.visual.vertex_colors[:, 3] = 255
    (tmp_path / "y.glb").write_bytes(to_glb(vertices))
    np.testing.assert_allclose(colour_at(load_mesh(tmp_path / "y.glb"), 0.3), RED, atol=3)
    with pytest.raises(InputError, match="vertex colours beside a texture"):
        load_mesh(coloured(path, texture=image, colours=np.column_stack([rows, [65535] * 4])))


def test_the_transform_of_a_texture(tmp_path):
    image, path = halves(GREEN, RED), tmp_path / "x.glb"
    for transform, left in (
        ({"offset": [0.5, 0]}, RED),
        ({"scale": [0.5, 1]}, GREEN),
        ({"scale": [-1, 1], "offset": [1, 0]}, RED),
        ({"rotation": np.pi, "offset": [1, 1]}, RED),
    ):
        mesh = load_mesh(coloured(path, texture=image, transform=transform))
        assert tuple(colour_at(mesh, 0.2)) == left
    # A quarter turn of the coordinates, counter-clockwise where v points down.
    mesh = load_mesh(coloured(path, texture=image, transform={"rotation": np.pi / 2}))
    np.testing.assert_allclose(mesh.visual.uv * [1, -1] + [0, 1], UV[:, ::-1] * [1, -1], atol=1e-6)


def test_a_texture_that_is_not_read_does_not_hide_the_shape(tmp_path):
    path = coloured(tmp_path / "x.glb", texture=b"\xabKTX 20\xbb" + bytes(90), mime="image/ktx2")
    assert len(read_mesh(path).faces) == 2


def test_parts_with_and_without_a_texture(tmp_path):
    """Together they have one texture."""
    made = Made()
    image = made.view(halves(GREEN, GREEN))
    square = {"attributes": {"POSITION": made.add(QUAD), "TEXCOORD_0": made.add(UV)}, "mode": 6}
    factor = {"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}}
    materials = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}, factor]
    more = {"images": [{"bufferView": image}], "textures": [{"source": 0}], "materials": materials}
    squares = (square | {"material": k} for k in (0, 1))
    mesh = load_mesh(made.write(tmp_path / "x.glb", *squares, **more))
    colours = mesh.visual.to_color().vertex_colors[:, :3]
    np.testing.assert_allclose(colours, [GREEN] * 4 + [(255, 0, 0)] * 4, atol=1)
