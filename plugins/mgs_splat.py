"""`mgs_splat`: Gaussian splatting as a Mitsuba integrator.

    integrator = {"type": "mgs_splat", "filename": "splats.ply"}
    scene = mi.load_dict({"type": "scene", "sensor": {...}, "integrator": integrator})
    params = mi.traverse(scene)  # integrator.means, .log_scales, .quats, .logit_opacities, .sh
    image = mi.render(scene, params)

Properties:

- `filename`: a 3DGS PLY, GLB or SPZ.
- `colour_space`: "linear" or "srgb", in which colours are blended. Default: linear for files of
  mgs, srgb for those of other tools.
- `antialiased`: boolean, whether Gaussians that are smaller than a pixel are fainter. Default: what
  the file says, else false.
- `background`: RGB behind the Gaussians in that space. Default: black.
- `depth`: boolean, append the expected z-depth in metres as an AOV. Default: false.

The image is linear, as all of Mitsuba's. The film adds alpha (`pixel_format` rgb or rgba). A pixel
is the value at its centre; shapes, emitters, the sampler and the film's reconstruction filter have
no effect.

Reverse and forward mode reach each parameter with enabled gradients, and the sensor's `to_world`,
`x_fov` and principal point.
"""

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mgs.errors import InputError
from mgs.gaussians import ARRAYS
from mgs.splat import ListCache, as_drjit, render
from mgs.splat.mitsuba_sensor import camera_from_sensor
from mgs.splat.rendering import as_colour
from mgs.splat_files import load_gaussians


class MgsSplat(mi.CppADIntegrator):
    """Integrator that renders Gaussians. They are its own parameters, since Mitsuba has no Python
    shapes."""

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        if not isinstance(props.get("filename"), str):
            raise InputError("mgs_splat: `filename` is missing or no string; name a 3DGS PLY")
        path = str(mi.file_resolver().resolve(props["filename"]))
        gaussians = load_gaussians(path)
        self.colour_space = props.get("colour_space", "linear" if gaussians.linear else "srgb")
        if self.colour_space not in ("linear", "srgb"):
            raise InputError(
                f"mgs_splat: colour_space {self.colour_space!r} is unknown; choose linear or srgb"
            )
        self.background = props.get("background", 0.0)
        as_colour(self.background)
        self.depth = props.get("depth", False)
        antialiased = props.get("antialiased", gaussians.antialiased)
        for name, value in (("depth", self.depth), ("antialiased", antialiased)):
            if not isinstance(value, bool):
                raise InputError(f"mgs_splat: {name} {value!r} must be a boolean")
        self.gaussians = as_drjit(replace(gaussians, antialiased=antialiased))
        self.cache = ListCache()

    def traverse(self, cb: Any) -> None:
        """Expose the five parameters, with shapes as in `mgs.gaussians.Gaussians`."""
        for name in ARRAYS:
            cb.put(name, getattr(self.gaussians, name), mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Any) -> None:
        """Do nothing: block lists are checked against the Gaussians at each use."""

    def aov_names(self) -> list[str]:
        """Channels after colour and alpha."""
        return ["depth.z"] if self.depth else []

    def render(
        self,
        scene: Any,
        sensor: Any = 0,
        seed: Any = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> Any:
        """Image of the sensor through its film, TensorXf [H,W,C]. `seed` and `spp` have no effect.

        Raises InputError for a sensor that is not `perspective`, or a parameter that
        `mgs.splat.rendering` refuses.
        """
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        film = sensor.film()
        image = render(self.gaussians, camera_from_sensor(sensor), self.background, self.cache)
        film.prepare(self.aov_names())
        film.put_block(mi.ImageBlock(self._channels(image, film), film.crop_offset()))
        developed = film.develop() if develop else mi.TensorXf()
        if evaluate:
            dr.eval(developed)
        return developed

    def sample(self, *_: Any, **__: Any) -> Any:
        """Refuse: whole images are drawn, not rays, so `aov` and `moment` cannot nest it."""
        raise InputError(
            "mgs_splat: draws whole images, not rays; render it alone, not within another "
            "integrator (its property `depth` adds depth)"
        )

    def render_backward(
        self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
    ) -> None:
        """Propagate the gradient of an image to the parameters."""
        with dr.resume_grad():
            image = self.render(scene, sensor)
            dr.set_grad(image, grad_in)
            dr.enqueue(dr.ADMode.Backward, image)
            dr.traverse(dr.ADMode.Backward)

    def render_forward(
        self, scene: Any, params: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
    ) -> Any:
        """Change of the image along the gradients set on the parameters, TensorXf [H,W,C]."""
        with dr.resume_grad():
            image = self.render(scene, sensor)
            return dr.forward_to(image, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)

    def _channels(self, image: Any, film: Any) -> Any:
        """Channels of an image block [H,W,C]: R G B, A if the film has it, filter weight, AOVs."""
        rgb = image.rgb
        if self.colour_space == "srgb":
            rgb = mi.TensorXf(mi.math.srgb_to_linear(rgb.array), rgb.shape)
        channels = [image.alpha] if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else []
        channels.append(dr.ones(mi.TensorXf, image.alpha.shape))
        if self.depth:
            channels.append(image.depth)
        return dr.concat([rgb, *(channel[..., None] for channel in channels)], axis=2)

    def to_string(self) -> str:
        """One line."""
        return f"MgsSplat[{len(self.gaussians)} Gaussians, SH degree {self.gaussians.sh_degree}]"


mi.register_integrator("mgs_splat", lambda props: MgsSplat(props))
