"""The format mgs: its transform, coder and allocation against brute force, and damaged files."""

import hashlib
import struct
import warnings
import zlib
from dataclasses import replace
from functools import partial
from itertools import islice, pairwise, product, starmap
from pathlib import Path

import numpy as np
import pytest
from program import command, output
from refusals import fails, refused
from test_render_command import CAMERAS, gaussians

import mgs
from mgs import load_prior, open_run, render, save_prior, vjp
from mgs.colour import srgb_from_linear
from mgs.compact import allocate, coder, container, decode
from mgs.compact.columns import Start, columns_of, gaussians_of, gradient_of, start_of
from mgs.compact.encode import Encoder
from mgs.compact.tree import DEPTH, cells_of, code_descendants, codes_of, tree_of
from mgs.data.frames import Frame
from mgs.data.world import PLUS_Z
from mgs.errors import InputError, Notice
from mgs.evaluation import render_view
from mgs.reports import compacting
from mgs.rotation import rotmat_from_quat
from mgs.run.folder import write_checkpoint
from mgs.run.nbv import start_fit
from mgs.splat_files import load_gaussians, upward
from mgs.splat_places import from_source

pytest.importorskip("constriction")
FILE = Path(__file__).parent / "corpus" / "MGS" / "one.mgs"


def scattered(n: int, seed: int = 0, side: int = 64) -> np.ndarray:
    """Sorted codes of cells, some of them equal."""
    rng = np.random.default_rng(seed)
    return codes_of(rng.integers(0, side, (n, 3)), rng.integers(0, 2, n))[1]


def signs(model, draws: int = 1):
    """Gradients of random signs, of each camera."""
    rng = np.random.default_rng(1)
    for camera in CAMERAS * draws:
        z = rng.choice([-1.0, 1.0], (camera.height, camera.width, 3)) / np.sqrt(draws)
        yield vjp(model, z.astype(np.float32), camera)


def change(a, b) -> float:
    """Squared change of the images, summed."""
    pairs = ((np.asarray(render(g, camera).rgb, float) for g in (a, b)) for camera in CAMERAS)
    return float(sum(np.square(x - y).sum() for x, y in pairs))


def test_the_transform_has_an_inverse_and_an_adjoint():
    tree, rng = tree_of(scattered(500), 9, 3), np.random.default_rng(2)
    x, g = rng.normal(size=(2, 500, 3))
    y = tree.forward(x)
    np.testing.assert_allclose(tree.inverse(y), x, atol=1e-12)
    assert (g * x).sum() == pytest.approx((tree.forward(g, adjoint=True) * y).sum())
    assert set(tree.tile) == {0, 1, 2, 3}
    np.testing.assert_allclose(tree.forward(np.ones((500, 1)))[:-1], 0, atol=1e-12)


def test_integers_come_back_at_once_or_in_layers():
    rng = np.random.default_rng(0)
    values = np.round(rng.laplace(size=(3000, 3)) * [0.3, 2, 40]).astype(int)
    values[:2, 0] = coder.LARGEST, -coder.LARGEST
    counts = [np.unique(column, return_counts=True)[1] / 3000 for column in values.T]
    ideal = 3000 / 8 * sum(-(p * np.log2(p)).sum() for p in counts)
    zeros = np.zeros_like(values)
    for layers in (1, 3):
        parts, size = [zeros, *allocate.rounded(values.astype(float), np.ones(3), layers)], 0
        np.testing.assert_array_equal(parts[-1], values)
        for before, part in pairwise(parts):
            data = coder.encode(partial(coder.integers, values=part, before=before))
            read = coder.integers(coder.decoder(data), zeros, before)
            np.testing.assert_array_equal(read, part)
            size += len(data)
        assert size < 1.1 * ideal


def test_cells_come_back_and_none_are_shared():
    rng = np.random.default_rng(0)
    cells, layer = rng.integers(0, 4, (40, 3)), np.zeros(40, np.int64)
    order, codes = codes_of(cells, layer)
    assert (np.diff(codes) > 0).all()
    assert sorted(order) == list(range(40))
    read = cells_of(codes)[0]
    assert (read == cells[order]).all(1).sum() >= 10
    root = np.zeros(1, int), DEPTH
    data = coder.encode(lambda s: code_descendants(s, *root, 40, codes))
    np.testing.assert_array_equal(code_descendants(coder.decoder(data), *root, 40), codes)
    with pytest.raises(ValueError, match="more than 39"):
        code_descendants(coder.decoder(data), *root, 39)


@pytest.mark.parametrize("degree", [0, 2])
def test_columns_are_gaussians_and_gradients_are_by_them(degree):
    model = gaussians(degree)
    model.log_scales[0, 1] = model.log_scales[0, 0] + 0.02  # nearly equal
    start = np.random.default_rng(3).normal(size=(40, 4))
    axes = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
    columns = columns_of(model, start, axes)
    back = gaussians_of(columns, model.means, start, axes)
    np.testing.assert_allclose(back.sh, model.sh, atol=1e-5)
    shapes = (
        np.einsum("nij,nj,nkj->nik", (turn := rotmat_from_quat(g.quats)), g.log_scales, turn)
        for g in (back, model)
    )
    np.testing.assert_allclose(*shapes, atol=1e-5)
    np.testing.assert_allclose(np.sort(back.log_scales), np.sort(model.log_scales), atol=1e-5)
    rng, step = np.random.default_rng(5), 1e-4
    weights = rng.normal(size=back.sh.shape), rng.normal(size=40), rng.normal(size=(40, 3, 3))

    def parts(g, quats, scales):
        """Weighted sums of colours, opacities and covariances, which no order of scales changes."""
        turn = rotmat_from_quat(quats)
        covariance = np.einsum("nij,nj,nkj->nik", turn, np.exp(2 * scales), turn)
        values = g.sh, g.logit_opacities, 100 * covariance
        sums = [(w * v).reshape(40, -1).sum(1) for w, v in zip(weights, values, strict=True)]
        return np.sum(sums, 0, np.float64)

    def total(c):
        g = gaussians_of(c, model.means, start, axes)
        return parts(g, g.quats, g.log_scales)

    quats, scales = back.quats.astype(float), back.log_scales.astype(float)
    by = {"sh": weights[0], "logit_opacities": weights[1]}
    by["quats"], by["log_scales"] = (
        np.column_stack([(parts(back, *ends[0]) - parts(back, *ends[1])) / 2e-4 for ends in pairs])
        for pairs in (
            [((quats + d, scales), (quats - d, scales)) for d in step * np.eye(4)],
            [((quats, scales + d), (quats, scales - d)) for d in step * np.eye(3)],
        )
    )
    direction = rng.normal(size=columns.shape)
    slope = (total(columns + step * direction) - total(columns - step * direction)) / (2 * step)
    each = gradient_of(back, start, axes, by) * direction
    each[np.abs(columns[:, -1] - 0.5) >= 6.4, -1] = 0  # opacities that are clamped
    assert (np.abs(each.sum(1) - slope) <= 2e-2 * np.abs(each).sum(1)).all()
    assert np.abs(each[:, -7:-1]).sum() > 0.1 * np.abs(each).sum()


def test_sensitivity_is_that_of_brute_force():
    """h of a band is the mean squared change of the images by a unit change of a coefficient."""
    model = replace(gaussians(0, 12), logit_opacities=np.full(12, 0.5, np.float32))
    axes, quats = np.eye(3), np.tile([1.0, 0, 0, 0], (12, 1))
    columns = columns_of(model, quats, axes)
    cells = decode.grid_cells(model.means, model.means.min(0), 0.02)
    order, codes = codes_of(cells, np.zeros(12, int))
    tree, base = tree_of(codes, 3, 1), gaussians_of(columns, model.means, quats, axes)
    model = replace(base, antialiased=False)
    coefficients, exact, step = tree.forward(columns[order]), np.zeros((12, 10)), 1e-2
    for k, column in product(range(12), (0, 4, 6, 9)):
        ends = []
        for sign in (1, -1):
            moved = coefficients.copy()
            moved[k, column] += sign * step
            other = np.empty_like(columns)
            other[order] = tree.inverse(moved)
            g = gaussians_of(other, model.means, quats, axes)
            ends.append(replace(g, antialiased=False))
        exact[k, column] = change(*ends) / (2 * step) ** 2
    each = [gradient_of(model, quats, axes, by)[order] for by in signs(model, 60)]
    turned = np.stack([tree.forward(one, adjoint=True) for one in each])
    h = allocate.sensitivity(turned, np.zeros(12, int))
    for column in (0, 4, 6, 9):
        assert h[0, column] == pytest.approx(exact[:, column].mean(), rel=0.2)


def test_the_expected_change_is_measured():
    """Roundings of independent Gaussians change the images as their sum of squares says."""
    model = gaussians(0, 400)
    model.logit_opacities = np.clip(model.logit_opacities, -2, 2)
    encoder = Encoder(model, lambda g: signs(g, 20))
    for scale in (0.002, 0.01):
        file = encoder.file(scale)
        assert change(file.model, model) == pytest.approx(file.expected, rel=0.5)


def small(**options) -> Encoder:
    return Encoder(gaussians(1, 300), signs, **options)


def test_a_file_gives_the_same_numbers_everywhere():
    """Bytes of a file, and a hash of the arrays that were read from it when it was made."""
    g = load_gaussians(FILE)
    digest = hashlib.blake2b(digest_size=8)
    for array in (g.means, g.log_scales, g.quats, g.logit_opacities, g.sh):
        digest.update(np.ascontiguousarray(array, "<f4").tobytes())
    assert (len(g), digest.hexdigest()) == (300, "02b6198249d92ab3")


def test_a_file_comes_back_as_its_encoder_says(tmp_path):
    up = (0.6, 0.0, 0.8)
    for options in ({}, {"up": up, "origin": (5e5, -2.0, 3.0)}):
        file = small(**options).file(0.01)
        path = tmp_path / "x.mgs"
        path.write_bytes(bytes(file))
        read = load_gaussians(path)
        assert len(read) == 300
        if not options:
            assert read == file.model
    assert upward(path) == pytest.approx(up)
    assert read.origin == (5e5, -2.0, 3.0)
    mgs.write_ply(tmp_path / "x.ply", gaussians(0))
    fails("needs no prior", load_gaussians, tmp_path / "x.ply", tmp_path)


@pytest.mark.parametrize("count", [1, 2])
def test_gaussians_at_one_place_come_back(count):
    some = gaussians(1, 300)[np.repeat(7, count)]
    file = Encoder(some, signs).file(0.001)
    size = float(np.exp(some.log_scales).mean())
    np.testing.assert_allclose(file.model.means, some.means, atol=size * count / 16)
    np.testing.assert_allclose(file.model.opacities, some.opacities, atol=1e-3)


def test_more_bytes_are_better_and_each_packet_improves(tmp_path):
    encoder = small()
    errors = [change(encoder.file(scale).model, encoder.g) for scale in (0.2, 0.05, 0.01)]
    assert errors[0] > errors[1] > errors[2]
    file, path, sizes = encoder.file(0.02), tmp_path / "x.mgs", []
    for most in np.linspace(len(bytes(file.header)) + 200, len(file), 6).astype(int):
        path.write_bytes(bytes(file.first(most)))
        assert path.stat().st_size <= most
        sizes.append(change(load_gaussians(path), encoder.g))
    assert sizes[0] > 3 * sizes[-1]
    assert np.mean(np.diff(sizes) <= 0) >= 0.8
    tops = replace(file, payloads={k: data for k, data in file.payloads.items() if k[0] == 0})
    nothing = replace(encoder.g, logit_opacities=np.full(300, -20, np.float32))
    assert change(tops.model, encoder.g) < 0.07 * change(nothing, encoder.g)


def test_what_is_cut_off_or_broken_is_lost_alone(tmp_path):
    file, path = small().file(0.02), tmp_path / "x.mgs"
    data, whole = bytes(file), change(file.model, small().g)
    start = len(bytes(file.header))
    path.write_bytes(data[: start + (len(data) - start) * 2 // 3])
    with pytest.warns(Notice, match=r"\d+ of \d+ packets are missing or damaged"):
        load_gaussians(path)
    at = data.index(container.MARK, start + 2000)
    broken = bytearray(data)
    broken[at + 12] ^= 1
    path.write_bytes(bytes(broken))
    with pytest.warns(Notice, match=f": 1 of {file.header.packets} packets"):
        read = load_gaussians(path)
    assert whole < change(read, small().g) < change(file.first(start + 600).model, small().g)


def test_a_layer_counts_only_with_those_before_it():
    file = small().file(0.02)
    chains = [key for key in file.payloads if key[2] == 1 and (*key[:2], 0) in file.payloads]
    assert chains
    for tile, group, _ in chains:
        without = {(tile, group, layer) for layer in range(3)}, {(tile, group, 0)}
        ends = [
            replace(file, payloads={k: v for k, v in file.payloads.items() if k not in lost}).model
            for lost in without
        ]
        assert ends[0] == ends[1]


def test_what_is_left_of_a_prior_is_placed_by_a_mask():
    """Gaussians that a receiver's prior also has take their entropy, and a lost packet of a mask
    leaves one for each node."""
    g, rng = gaussians(0, 4000), np.random.default_rng(0)
    quats, layer = np.tile([1.0, 0, 0, 0], (4000, 1)), np.arange(4000) // 2500
    start = Start(g.means.astype(float), quats, layer, bytes(16), 0.0)
    for share in (0.5, 0.1):
        kept = np.flatnonzero(rng.random(4000) < share)
        some, gradients = g[kept], lambda model: signs(model)
        file = Encoder(some, gradients, start, kept).file(0.05)
        np.testing.assert_array_equal(file.model.means, some.means)
        size = sum(len(data) for key, data in file.payloads.items() if key[1] == "position")
        p = len(kept) / 4000
        assert size < 1.2 * 500 * -(p * np.log2(p) + (1 - p) * np.log2(1 - p)) + 20
        lost = {k: v for k, v in file.payloads.items() if k[:2] != (1, "position")}
        few = replace(file, payloads=lost).model
        assert 0 < len(few) < len(kept) / 2
        assert {tuple(mean) for mean in few.means} <= {tuple(mean) for mean in g.means}


def hostile(data: bytes, place: int, form: str, value) -> bytes:
    """A file with a number of its header replaced, and the sum that fits it."""
    end = next(
        k for k in range(200, 2000) if zlib.crc32(data[:k]).to_bytes(4, "little") == data[k : k + 4]
    )
    head = bytearray(data[:end])
    struct.pack_into(form, head, place, value)
    return bytes(head) + zlib.crc32(bytes(head)).to_bytes(4, "little") + data[end + 4 :]


@pytest.mark.parametrize(
    ("place", "form", "value", "message"),
    [
        (4, "<B", 1, "version 1"),
        (5, "<B", 255, "give the prior"),
        (6, "<B", 9, "SH degree 9"),
        (7, "<B", 0, "impossible numbers"),
        (7, "<B", 60, "more than|impossible|not a readable"),
        (9, "<I", 0, "impossible numbers"),
        (9, "<I", 1 << 31, "impossible numbers"),
        (13, "<H", 0, "impossible numbers"),
        (17, "<d", float("nan"), "impossible numbers"),
        (89, "<d", -1.0, "impossible numbers"),
        (129, "<H", 65535, "damaged or incomplete"),
        (140, "<I", 0, "impossible numbers"),
    ],
)
def test_hostile_headers_are_refused(tmp_path, place, form, value, message):
    path = tmp_path / "x.mgs"
    path.write_bytes(hostile(FILE.read_bytes(), place, form, value))
    fails(message, load_gaussians, path)


def test_damaged_files_are_refused_or_read(tmp_path):
    data, path, rng = FILE.read_bytes(), tmp_path / "x.mgs", np.random.default_rng(0)
    lines = list[str]()
    for trial in range(150):
        broken = bytearray(data[: rng.integers(0, len(data))] if trial % 3 == 0 else data)
        for at in rng.integers(0, max(len(broken), 1), rng.integers(0, 4)):
            if len(broken):
                broken[at] = rng.integers(256)
        payload = rng.bytes(40)
        if trial % 3 == 2:  # packets whose sums are right
            key = int(rng.integers(3)), container.GROUPS[rng.integers(4)], int(rng.integers(3))
            end = data.index(container.MARK, 200)
            broken = bytearray(data[:end] + container.packet(key, payload) + data[end:])
        path.write_bytes(bytes(broken))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Notice)
            try:
                assert len(load_gaussians(path)) <= 1000
            except InputError as error:
                lines.append(str(error))
    assert lines
    assert not any("\n" in line for line in lines)


@pytest.fixture
def short_searches(monkeypatch):
    """Steps are found to a factor of 1.5."""
    monkeypatch.setattr(compacting, "HALVINGS", 4)


def test_the_command_writes_what_fits_and_programs_read_it(
    dataset, prior, tmp_path, capsys, short_searches
):
    run = tmp_path / "run"
    small_run(dataset, prior, run)
    capsys.readouterr()
    printed = output(capsys, "export", run, "--bytes", "2k")
    alone = run / "export.mgs"
    assert alone.stat().st_size <= 2000
    assert f"{alone.stat().st_size:,} bytes" in printed
    shared = tmp_path / "shared.mgs"
    command("export", run, "--bytes", "1.2k", "--shared-prior", "--out", shared)
    assert shared.stat().st_size <= 1200
    read, whole = load_gaussians(shared, prior), open_run(run).gaussians
    assert len(read) == len(whole)
    np.testing.assert_allclose(read.means, whole.means, atol=2e-3)
    command("render", shared, "--prior", prior, "--cameras", dataset, "--out", tmp_path / "views")
    command("eval", alone)
    command("export", shared, "--prior", prior, "--to", "ply", "--out", tmp_path / "x.ply")
    assert mgs.read_ply(tmp_path / "x.ply") == replace(read, sh=mgs.read_ply(tmp_path / "x.ply").sh)
    assert "give the prior" in refused(capsys, ["eval", shared, "--dataset", dataset])
    points = load_prior(prior)
    other = replace(points, points=points.points + 0.01)
    mgs.save_prior(tmp_path / "other", other)
    fails("another prior", load_gaussians, shared, tmp_path / "other")
    opened = open_run(run)
    views = opened.taken
    _, (half, kept) = islice(compacting.thinned(opened, whole=True), 2)
    shared.write_bytes(bytes(compacting.encoding(opened, shared=True)(half, kept).file(0.05)))
    np.testing.assert_array_equal(load_gaussians(shared, prior).means, read.means[kept])
    truth = [
        (srgb_from_linear(rgba[..., :3]), weight > 0) for rgba, weight in map(Frame.target, views)
    ]
    for kind, limit in (("compressed-ply", 1100), ("spz", 600)):
        for option, value in (("--bytes", limit), ("--psnr", 22)):
            path = tmp_path / f"{kind}{option}"
            command("export", run, "--to", kind, option, value, "--out", path)
            model = from_source(load_gaussians(path), opened.dataset.world)
            drawn = [srgb_from_linear(render_view(model, frame.camera)[0]) for frame in views]
            pairs = zip(drawn, truth, strict=True)
            quality = np.mean([mgs.psnr(image[mask], true[mask]) for image, (true, mask) in pairs])
            assert f"{quality:.2f} dB in the file" in " ".join(capsys.readouterr().out.split())
            assert quality >= 22
            assert 10 < len(model) < len(whole)
            assert option == "--psnr" or 0.9 * limit < path.stat().st_size <= limit
    for options, message in (
        (["--bytes", "x"], "expected a number of bytes"),
        (["--bytes", "9", "--psnr", "3"], "one of"),
        (["--to", "mgs"], "one of"),
        (["--to", "spz", "--bytes", "20"], "ask for more bytes"),
        (["--to", "colmap", "--bytes", "2k"], "not for views; leave them out"),
        (["--bytes", "200"], "ask for more bytes"),
        (["--psnr", "90"], "ask for less"),
        (["--shared-prior", "--to", "spz"], "leave it out"),
    ):
        assert message in refused(capsys, ["export", run, *options, "--force"])
    command("export", run, "--psnr", "12", "--shared-prior", "--force")
    size_with_prior = alone.stat().st_size
    assert size_with_prior < 1200
    prior.rename(tmp_path / "gone")
    command("export", run, "--bytes", "2k", "--force")
    assert size_with_prior < alone.stat().st_size <= 2000


def small_run(dataset, prior, out, **train):
    settings = {"prior": prior, "seeds": 4, "budget": 0, "train": {"passes": 5, **train}}
    return mgs.run_nbv(dataset, out, **settings)


def test_fewer_gaussians_are_tried_until_all_fit_at_the_finest_steps(
    dataset, prior, tmp_path, monkeypatch
):
    run, tried = small_run(dataset, prior, tmp_path / "run"), []
    models = list(compacting.thinned(run, whole=True))
    again = lambda *_, **__: (tried.append(model) or model for model in models)  # noqa: E731
    monkeypatch.setattr(compacting, "thinned", again)
    encoder, finest = compacting.encoding(run, shared=True), compacting.SCALES[0]
    sizes = [len(encoder(*model).file(finest)) for model in models]
    for size in (sizes[-1], sizes[2] * 9 // 10, sizes[1] * 9 // 10, sizes[0]):
        tried.clear()
        compacting.compact_run(run, size, shared=True)
        assert len(tried) == 1 + next(k for k, s in enumerate(sizes) if s <= size)


def test_a_small_file_is_better_with_fewer_gaussians_fitted_once_more(
    dataset, prior, tmp_path, short_searches
):
    run = small_run(dataset, prior, tmp_path / "run")
    made = compacting.compact_run(run, 400)
    encoders = starmap(compacting.encoding(run, shared=False), compacting.thinned(run, whole=False))
    files = [compacting._fitted(encoder, 400, None) for encoder in encoders]
    pruned, measured = files[0], compacting._measure(run)
    assert made.psnr[1] > max(measured(file.model) for file in files if file)
    prior.rename(tmp_path / "gone")
    unfitted = compacting.compact_run(open_run(run.folder), 400)
    assert max(len(made.data), len(pruned), len(unfitted.data)) <= 400
    assert made.count < len(pruned.model)
    assert made.psnr[1] > measured(pruned.model) + 1
    assert made.psnr[1] > unfitted.psnr[1] + 0.2


@pytest.mark.parametrize("shared", [True, False])
def test_what_a_file_gives_is_fitted_and_written_again(
    dataset, prior, tmp_path, shared, short_searches
):
    run = small_run(dataset, prior, tmp_path / "run")
    encoder, size, measured = compacting.encoding(run, shared), 900, compacting._measure(run)
    models = list(compacting.thinned(run, whole=shared))
    files = [compacting._fitted(encoder(*model), size, None) for model in models]
    made = compacting.compact_run(run, size, shared=shared)
    assert len(made.data) <= size
    assert made.psnr[1] > max(measured(file.model) for file in files if file) + 0.02
    fit = compacting.refitting(run)
    for file, (_, kept) in zip(files, models, strict=True):
        if file and len(file.model) == len(kept):
            plan = encoder(fit(file.model), kept, file.header).plan(max(file.header.scale, 0.1))
            model = plan.file(plan.values).model
            np.testing.assert_array_equal(model.means, file.model.means)
            assert plan.model(plan.whole(plan.values)) == model
            np.testing.assert_allclose(plan.model(plan.values_of(model)).sh, model.sh, atol=1e-3)
    psnr = made.psnr[0] - 1
    smaller = compacting.compact_run(run, psnr=psnr, shared=shared)
    assert psnr <= smaller.psnr[1] < made.psnr[1]
    assert len(smaller.data) < len(made.data)


def test_more_and_more_numbers_are_held_while_the_rest_is_fitted(dataset, prior, tmp_path):
    """The fit is a change of every number that it may learn."""
    run, calls = small_run(dataset, prior, tmp_path / "run"), []
    plan = compacting.encoding(run, shared=True)(run.gaussians, np.arange(40)).plan(0.1)
    steps = plan.header.last_steps[plan.tree.band]

    def fit(g, rate, learn, passes=None):
        calls.append((g, rate, tuple(learn), passes))
        moved = replace(g, sh=g.sh * 1.2, logit_opacities=g.logit_opacities + 0.3)
        return replace(moved, log_scales=g.log_scales - 0.1 * ("scale" in learn))

    file = compacting.settled(plan, fit)
    zero = plan.whole(plan.values) == 0
    assert 0.05 < zero.mean() < 0.95
    shares = []
    for g, *_ in calls:
        values = plan.values_of(g)
        apart = abs(values - plan.whole(values)) / steps
        assert apart[zero].max() < 0.01
        shares.append((apart < 0.01).mean())
    assert all(np.diff(shares) > 0.02)
    assert shares[-1] == 1
    assert all(np.diff([rate for _, rate, *_ in calls[:-1]]) < 0)
    assert {passes for *_, passes in calls[:-1]} == {1}
    before, _, learn, _ = calls[-1]
    assert learn == ("colour", "opacity")
    np.testing.assert_allclose(file.model.log_scales, before.log_scales, atol=1e-5)
    assert file.model.logit_opacities.mean() > before.logit_opacities.mean() + 0.1


@pytest.mark.slow
def test_fits_between_roundings_make_files_better(tmp_path):
    """A rock of 1,500 Gaussians, in as many bytes or fewer."""
    data = mgs.synth_orbit(tmp_path / "data", frames=12, size=(64, 48), spp=4)
    prior = save_prior(tmp_path / "prior", mgs.build_prior(data, gaussians=1500))
    run = mgs.resume_nbv(start_fit(data.root, tmp_path / "run", prior=prior))
    g, measured = run.gaussians, compacting._measure(run)
    plan = compacting.encoding(run, shared=True)(g, np.arange(len(g))).plan(0.1)
    plain, settled = plan.file(plan.values), compacting.settled(plan, compacting.refitting(run))
    assert len(settled) <= len(plain)
    assert measured(settled.model) > measured(plain.model) + 0.2


def test_thinning_goes_on_from_fitted_gaussians_only_if_half_are_gone(
    dataset, prior, tmp_path, monkeypatch
):
    """A fit is replaced by a doubling of quaternions, which shows how many came before."""
    fits = list[tuple[int, int]]()

    def again(g):
        norm = np.linalg.norm(g.quats, axis=1)
        fits.append((len(g), round(float(np.median(np.log2(norm))))))
        return replace(g, quats=2 * g.quats)

    run = small_run(dataset, prior, tmp_path / "run")
    monkeypatch.setattr(compacting, "refitting", lambda run: again)
    best = compacting._measure(run)(run.gaussians)
    compacting.thin_run(run, "compressed-ply", psnr=best - 1)
    assert len(fits) > 3
    assert {before for _, before in fits} == {0}
    fits.clear()
    compacting.thin_run(run, "compressed-ply", psnr=best - 15)
    assert [before for _, before in fits[:3]] == [0, 1, 2]


@pytest.mark.parametrize("space", ["srgb", "linear"])
def test_a_size_below_one_gaussian_is_refused_before_any_fit(
    dataset, prior, tmp_path, monkeypatch, space
):
    run = small_run(dataset, prior, tmp_path / "run", space=space)
    fitted = lambda *_, **__: pytest.fail("fitted")  # noqa: E731
    monkeypatch.setattr("mgs.fit.fitting.fit_gaussians", fitted)
    fails("one Gaussian takes .* ask for more", compacting.thin_run, run, "spz", size=20)


def test_the_start_hides_the_last_bits(prior):
    exact = load_prior(prior)
    near = replace(exact, points=exact.points * (1 + 2e-16), normals=exact.normals * (1 - 2e-16))
    one, other = start_of(exact, 0.01), start_of(near, 0.01)
    assert one.digest == other.digest
    np.testing.assert_array_equal(one.means, other.means)
    np.testing.assert_array_equal(one.quats, other.quats)
    assert exact.world.up == PLUS_Z


def test_no_more_gaussians_are_read_than_the_header_says(tmp_path, monkeypatch):
    """Each of the tiles has fewer; room is checked for the number of the header."""
    monkeypatch.setattr("mgs.compact.encode.TILE", 100)
    file, path = small().file(0.02), tmp_path / "x.mgs"
    assert file.header.tiles == 3
    path.write_bytes(bytes(replace(file, header=replace(file.header, n=299))))
    fails("more Gaussians than its header says", load_gaussians, path)


def test_a_scene_is_coded_without_what_no_view_shows(dataset, prior, tmp_path, monkeypatch):
    """Pruning alone leaves some of it, since it takes no neighbours at once."""
    run = small_run(dataset, prior, tmp_path / "run")
    model, unseen = run.gaussians[[*range(len(run.gaussians)), *[0] * 60]], slice(-60, None)
    model.means[unseen] = np.random.default_rng(0).normal((0, 0, 60), 0.5, (60, 3))
    H = sum(mgs.fisher(model, frame.camera) for frame in run.taken)
    write_checkpoint(run.folder, replace(run.state, gaussians=model, H=H))
    mgs.write_ply(run.folder / "gaussians.ply", model)
    monkeypatch.setattr(mgs.Run, "of_scene", True)
    run = open_run(run.folder)
    assert not run.shown[unseen].any()
    for some, kept in islice(compacting.thinned(run, whole=False), 2):
        assert len(some) == len(kept) > 0
        assert run.shown[kept].all()
