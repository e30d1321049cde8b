"""Constants of Gaussian splatting, each with unit, reason and source. With them images agree with
gsplat's CUDA kernels."""

EPS2D = 0.3
"""px^2, added to the diagonal of the 2D covariance: a low-pass filter of about one pixel (3DGS, EWA
splatting)."""

ALPHA_MIN = 1.0 / 255.0
"""No unit. A splat is not drawn on a pixel where its alpha is below one step of an 8-bit image
(3DGS)."""

ALPHA_MAX = 0.999
"""No unit. Alpha is clamped here, so that 1 - alpha, by which the adjoint divides, is never zero
(gsplat)."""

TRANSMITTANCE_MIN = 1e-4
"""No unit. A pixel is finished when the next splat would leave a transmittance of no more than this
(3DGS). That splat is not drawn, nor is any behind it."""

FRUSTUM_MARGIN = 0.3
"""No unit, a share of the half field of view. EWA splatting approximates the projection by its
Jacobian at a Gaussian's centre. Far outside the image that is meaningless, so the Jacobian is taken
at the centre clamped to the image and this margin around it (3DGS's factor 1.3)."""

NEAR = 0.01
"""m, near plane: Gaussians whose centre is nearer are not drawn."""

LOG_SCALE_RANGE = (-16.0, 9.0)
"""ln m. Log-scales are clamped to this range (0.1 micrometre to 8 km), beyond which float32
covariances overflow. No scene comes near it. Outside, the derivative with respect to the log-scale
is zero."""
