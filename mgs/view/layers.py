"""Layers of the viewer, as colours of Gaussians and as images of the kernel.

A browser draws Gaussians in sRGB, sorted as a whole and without spherical harmonics: an
approximation, shown while the camera moves. The kernel's images are the model as `mgs.render` draws
it.
"""

from __future__ import annotations

import numpy as np

from mgs.camera import Camera
from mgs.colour import srgb_from_linear
from mgs.gaussians import Gaussians
from mgs.plotting import painted
from mgs.report.diagnostics import PANELS, VISIBLE, view_maps
from mgs.rotation import rotmat_from_quat
from mgs.view.access import plain
from mgs.view.subject import SCALARS, Subject

FAR = 160.0
"""Depth of pixels that show no model, metres: viser's images of depth end at 167 m."""


def layers(subject: Subject) -> list[str]:
    """Names of the layers that a subject has."""
    return ["colour", "alpha", "depth", *(name for name in SCALARS if name in subject.scalars)]


def _model(subject: Subject) -> Gaussians:
    assert subject.gaussians is not None
    return subject.gaussians


def covariances(subject: Subject) -> np.ndarray:
    """Covariance matrices of the Gaussians in the world, m², float32 [N,3,3]."""
    g = _model(subject)
    axes = rotmat_from_quat(g.quats) * np.exp(g.log_scales.astype(np.float64))[:, None, :]
    return (axes @ axes.transpose(0, 2, 1)).astype(np.float32)


def gaussian_colours(subject: Subject, layer: str) -> np.ndarray:
    """Colours of the Gaussians in a layer, sRGB uint8 [N,3]; grey for depth."""
    g = _model(subject)
    if layer == "colour":
        return _eight_bits(_display(g, g.rgb))
    if layer in subject.scalars:
        return painted(subject.scalars[layer], PANELS[layer][1], *scale(subject, layer))
    return np.full((len(g), 3), 255 if layer == "alpha" else 128, np.uint8)


def kernel_image(
    subject: Subject, camera: Camera, layer: str
) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """Draw a layer from a camera: sRGB uint8 [H,W,3], z-depth float32 [H,W], and (low, high) of the
    colour scale.

    The camera and the depth have the lengths that are shown; a colour scale of depth has those of
    the world (`Subject.scale`). Behind the model it is black, and FAR away. Layers other than
    colour and alpha are drawn where the opacity is at least VISIBLE.
    """
    scalars = {layer: subject.scalars[layer]} if layer in subject.scalars else {}
    maps = view_maps(_model(subject), camera, scalars)
    seen = maps["A"] >= VISIBLE
    depth = np.where(seen, maps["Z"], FAR).astype(np.float32)
    if layer == "colour":
        rgb = np.stack([maps[channel] for channel in "RGB"], axis=-1)
        return _eight_bits(_display(_model(subject), rgb)), depth, (0.0, 1.0)
    if layer == "alpha":
        grey = _eight_bits(np.clip(maps["A"], 0, 1))
        return np.stack([grey] * 3, axis=-1), depth, (0.0, 1.0)
    if layer == "depth":
        found = maps["Z"][seen]
        low, high = (float(found.min()), float(found.max())) if found.size else (0.0, 1.0)
        values, colours = maps["Z"], PANELS["Z"][1]
        ends = low / subject.scale, high / subject.scale
    else:
        low, high = ends = scale(subject, layer)
        values, colours = maps[layer], PANELS[layer][1]
    return painted(values, colours, low, high) * seen[..., None].astype(np.uint8), depth, ends


def scale(subject: Subject, layer: str) -> tuple[float, float]:
    """Ends of the colour scale of a scalar: 0 to 1; of information 0 to its 99.9 %."""
    if layer != "information":
        return 0.0, 1.0
    return 0.0, max(float(np.quantile(subject.scalars[layer], 0.999)), 1e-9)


def legend(layer: str, ends: tuple[float, float], unit: str) -> str:
    """Meaning of the colours of a layer, in one line. unit: name of a length of 1."""
    (low, high), name = ends, plain(unit)
    return {
        "colour": "The colours of the model.",
        "alpha": "Opacity: black 0, white 1.",
        "depth": f"Depth: dark {low:.3g} {name}, bright {high:.3g} {name}. "
        "Grey while the camera moves.",
        "information": f"Information gained: dark 0, bright {high:.0f} nats and more.",
        "uncertainty": "Variance left over that of the prior: blue 0, all known; yellow 1, "
        "nothing.",
        "unobserved": "Yellow: no image has seen this part of the surface.",
    }[layer]


def _eight_bits(values: np.ndarray) -> np.ndarray:
    return np.round(values * 255).astype(np.uint8)


def _display(g: Gaussians, rgb: np.ndarray) -> np.ndarray:
    """Colours of a model as sRGB in [0,1]."""
    return srgb_from_linear(rgb) if g.linear else np.clip(rgb, 0, 1)
