"""Choice of libLLVM and variant, and one line for those that do not work."""

from pathlib import Path

import pytest
from program import python
from refusals import fails

from mgs import InputError, runtime
from mgs.runtime import MIN_LLVM, Libllvm

OLD = [path for path in runtime._candidates() if runtime.load_libllvm(path).version[0] < MIN_LLVM]


def test_finds_what_dr_jit_uses_on_this_processor():
    import drjit as dr

    assert runtime.find_libllvm().version == dr.detail.llvm_version()
    runtime.check_kernel()
    facts = runtime.processor()
    assert facts["threads"] == dr.thread_count()
    assert facts["cpu"] not in ("", "unknown")
    assert facts["simd_width"] in (4, 8, 16)


def fake(monkeypatch, libraries: dict[str, int | None]) -> None:
    """Fake the libraries of the system, in Dr.Jit's order; None: does not load."""

    def load(path: str) -> Libllvm:
        version = libraries.get(path)
        if version is None:
            raise InputError(f"libLLVM {path}: does not load")
        return Libllvm(path, (version, 0, 0))

    monkeypatch.setattr(runtime, "load_libllvm", load)
    monkeypatch.setattr(runtime, "_candidates", lambda: list(libraries))


def test_order(monkeypatch):
    monkeypatch.delenv(runtime.LIBRARY_VARIABLE, raising=False)
    fake(monkeypatch, {"first": 22, "second": 19})
    assert runtime.find_libllvm().path == "first"
    fake(monkeypatch, {"old": 14, "broken": None, "good": 19})
    assert runtime.find_libllvm().path == "good"
    fake(monkeypatch, {"old": 15, "older": 14})
    said = r"old: is version 15, older than 19; install version 19 or newer.*apt-get.*conda"
    fails(said, runtime.find_libllvm)
    fake(monkeypatch, {})
    fails("none found; install version 19", runtime.find_libllvm)


def test_an_explicit_choice_is_honoured(monkeypatch):
    fake(monkeypatch, {"good": 19, "old": 15})
    monkeypatch.setenv(runtime.LIBRARY_VARIABLE, "old")
    said = "is version 15, older than 19, but DRJIT_LIBLLVM_PATH names it"
    fails(said, runtime.find_libllvm)
    monkeypatch.setenv(runtime.LIBRARY_VARIABLE, "")
    assert runtime.find_libllvm().path == "good"


def test_versions_are_compared_as_numbers(tmp_path):
    for name in ("libLLVM-9.so.1", "libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM.so.22.1"):
        (tmp_path / name).touch()
    names = [Path(path).name for path in runtime._installed((str(tmp_path),), "libLLVM*.so.*")]
    assert names == ["libLLVM.so.22.1", "libLLVM.so.19.1", "libLLVM-15.so.1", "libLLVM-9.so.1"]


LIBRARIES = [("/nowhere/libLLVM.so", "no such file"), (__file__, "does not load")]
LIBRARIES += [("libm.so.6", "is another library")]
LIBRARIES += [(path, f"is version 1[0-8], older than {MIN_LLVM}") for path in OLD]


@pytest.mark.parametrize(("library", "message"), LIBRARIES)
def test_a_bad_library_is_named(monkeypatch, library, message):
    monkeypatch.setenv(runtime.LIBRARY_VARIABLE, library)
    assert runtime.LIBRARY_VARIABLE in fails(message, runtime.find_libllvm)


def test_the_doctor_names_a_bad_library_in_one_line_and_exits_with_2():
    code = "from mgs.cli.app import main; main(['doctor'])"
    result = python(code, env={runtime.LIBRARY_VARIABLE: "/nowhere.so", "COLUMNS": "400"})
    assert result.returncode == 2, result.stderr
    (line,) = [line for line in result.stdout.splitlines() if line.startswith("wrong:")]
    assert "no such file" in line
    assert runtime.LIBRARY_VARIABLE in line


PREPARE = """
import numpy as np, mitsuba as mi
from mgs import runtime
from mgs.camera import Camera
from mgs.data.meshes import Mesh
from mgs.data.raycast import mesh_depth
from mgs.errors import InputError
from mgs.gaussians import Gaussians
from mgs.splat import fisher, render
one = Gaussians(*(np.ones(shape, np.float32) for shape in ((1, 3), (1, 3), (1, 4), 1, (1, 1, 3))))
camera = Camera(np.diag([20.0, 20.0, 1.0]), 16, 12, np.eye(4))
mesh = Mesh(np.eye(3) + [0, 0, 2], np.array([[0, 1, 2]]), np.ones(1, bool))
def said(call):
    try:
        call()
        print(mi.variant())
    except InputError as error:
        print(mi.variant(), error)
said(lambda: render(one, camera))
"""


VARIANTS = {
    "nonsense": "Mitsuba has no such variant; choose llvm_ad_rgb",
    "cuda_ad_rgb": "Dr.Jit finds no NVIDIA GPU",
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_variant_that_cannot_run_is_one_line(variant):
    done = python(PREPARE, env={"MGS_VARIANT": variant, "CUDA_VISIBLE_DEVICES": ""})
    assert f"MGS_VARIANT={variant}: {VARIANTS[variant]}" in done.stdout, done.stderr


def test_a_call_sets_a_variant_or_keeps_a_usable_one_and_refuses_others():
    calls = "runtime.start", "lambda: render(one, camera)", "lambda: fisher(one, camera)"
    program = f"{PREPARE}mi.set_variant('llvm_ad_spectral')\nsaid(runtime.start)\n"
    program += "mi.set_variant('scalar_rgb')\n"
    program += f"for call in ({', '.join(calls)}, lambda: mesh_depth(mesh)):\n    said(call)\n"
    done = python(f"{program}mi.set_variant('llvm_ad_rgb')\nsaid(runtime.start)")
    first, second, *others, last = done.stdout.splitlines()
    assert first == "llvm_ad_rgb", done.stderr
    assert "llvm_ad_spectral is set" in second
    assert len(others) == 4
    assert all(line.startswith("scalar_rgb Mitsuba's variant scalar_rgb is set") for line in others)
    assert last == "llvm_ad_rgb"


def test_nothing_in_the_current_folder_is_code_or_style(tmp_path):
    """Mitsuba would load its plugins from there, and matplotlib have LaTeX set every text."""
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins/sphere.so").touch()
    (tmp_path / "matplotlibrc").write_text("text.usetex: True")
    program = "from mgs import runtime\nruntime.start()\nimport mitsuba as mi\n"
    program += "from mgs.plotting import drawing\nmi.load_dict({'type': 'sphere'})\n"
    program += "with drawing('a.png', 2, 2) as figure:\n    figure.suptitle('a')"
    done = python(program, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
