"""Constants of Gaussian splatting, each with unit, reason and source. With these, images agree with CUDA gsplat."""

EPS2D = 0.3
"""px^2, added to the diagonal of the 2D covariance: a low-pass filter of about one pixel (3DGS, EWA splatting)."""

ALPHA_MIN = 1.0 / 255.0
"""A splat's contribution below one 8-bit step is skipped (3DGS)."""

ALPHA_MAX = 0.999
"""Upper clamp of alpha, so that 1 - alpha never vanishes in the adjoint (gsplat)."""

TRANSMITTANCE_MIN = 1e-4
"""A pixel is finished where the next splat would leave no more than this transmittance (3DGS); that splat is not drawn."""

FRUSTUM_MARGIN = 0.3
"""Share of the half field of view by which the projection Jacobian's point may leave the image before it is clamped
(3DGS's factor 1.3): the affine approximation of EWA is meaningless far outside the frustum."""

NEAR = 0.01
"""m, near plane: Gaussians whose centre is nearer are not drawn."""

LOG_SCALE_RANGE = (-16.0, 9.0)
"""ln m, clamp of log-scales (0.1 micrometre to 8 km): beyond it float32 covariances overflow; no scene comes near.
Outside the range the derivative is zero."""
