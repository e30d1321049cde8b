"""Layers of the viewer, as colours of Gaussians and as images of the kernel."""

import numpy as np

from mgs.camera import Camera
from mgs.colour import srgb_from_linear
from mgs.gaussians import Gaussians
from mgs.plotting import painted
from mgs.reports.diagnostics import PANELS, VISIBLE, picture, view_maps
from mgs.rotation import rotmat_from_quat
from mgs.view.access import plain
from mgs.view.subject import Subject

FAR = 160.0  # depth of pixels that show no model, metres: viser's images of depth end at 167 m

LEGENDS = {
    "colour": "The colours of the model.",
    "alpha": "Opacity: black 0, white 1.",
    "depth": "Depth: dark {low:.3g} {unit}, bright {high:.3g} {unit}. Grey while the camera moves.",
    "information": "Information gained: dark 0, bright {high:.0f} nats and more.",
    "uncertainty": "Variance left over that of the prior: blue 0, all known; yellow 1, nothing.",
    "unobserved": "Yellow: no image has seen this part of the surface.",
}
"""Layers, and the meaning of their colours."""


def layers(subject: Subject) -> list[str]:
    return ["colour", "alpha", "depth", *subject.scalars]


def covariances(g: Gaussians) -> np.ndarray:
    """Covariance matrices of the Gaussians in the world, m², float32 [N,3,3]."""
    axes = rotmat_from_quat(g.quats) * np.exp(g.log_scales.astype(np.float64))[:, None, :]
    return (axes @ axes.transpose(0, 2, 1)).astype(np.float32)


def gaussian_colours(subject: Subject, layer: str) -> np.ndarray:
    """Colours of the Gaussians in a layer, sRGB uint8 [N,3]; grey for depth."""
    g = subject.model
    if layer == "colour":
        srgb = srgb_from_linear(g.linear_rgb(g.rgb))
        return np.round(255 * srgb).astype(np.uint8)
    if layer in subject.scalars:
        return painted(subject.scalars[layer], PANELS[layer][1], *scale(subject, layer))
    return np.full((len(g), 3), 255 if layer == "alpha" else 128, np.uint8)


def kernel_image(
    subject: Subject, camera: Camera, layer: str
) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """Draw a layer from a camera: sRGB uint8 [H,W,3], z-depth float32 [H,W], and (low, high) of the
    colour scale.

    Camera and depth have the lengths that are shown, the scale of depth those of the world. Behind
    the model it is black, and FAR away. Scalars are drawn where the opacity is at least VISIBLE."""
    scalars = {layer: subject.scalars[layer]} if layer in subject.scalars else {}
    maps = view_maps(subject.model, camera, scalars)
    opaque = maps["A"] >= VISIBLE
    depth = np.where(opaque, maps["Z"], FAR).astype(np.float32)
    if layer == "colour":
        return np.round(255 * picture(maps)).astype(np.uint8), depth, (0.0, 1.0)
    if layer == "alpha":
        grey = np.round(255 * np.clip(maps["A"], 0, 1)).astype(np.uint8)
        return np.stack([grey] * 3, axis=-1), depth, (0.0, 1.0)
    low, high = scale(subject, layer)
    if layer == "depth" and opaque.any():
        low, high = float(depth[opaque].min()), float(depth[opaque].max())
    channel = "Z" if layer == "depth" else layer
    image = painted(maps[channel], PANELS[channel][1], low, high)
    lengths = subject.scale if layer == "depth" else 1.0
    return image * opaque[..., None].astype(np.uint8), depth, (low / lengths, high / lengths)


def scale(subject: Subject, layer: str) -> tuple[float, float]:
    """Ends of the colour scale of a scalar: 0 to 1; of information 0 to its 99.9 %."""
    if layer != "information":
        return 0.0, 1.0
    return 0.0, max(float(np.quantile(subject.scalars[layer], 0.999)), 1e-9)


def legend(layer: str, ends: tuple[float, float], unit: str) -> str:
    """Meaning of the colours of a layer, in one line. unit: name of a length of 1."""
    return LEGENDS[layer].format(low=ends[0], high=ends[1], unit=plain(unit))
