"""Constants of Gaussian splatting, with unit, reason and source. Images agree with gsplat's CUDA
kernels."""

EPS2D = 0.3
"""px^2. Added to the diagonal of the 2D covariance: a low-pass filter of about one pixel (3DGS)."""

COMPENSATION_MIN = 1e-6
"""No unit. Lower bound of sqrt(det S / det(S + EPS2D I)), the factor on the opacity of antialiased
Gaussians with the 2D covariance S (Yu et al. 2024, Mip-Splatting, Eq. 10; `compensations` of
gsplat). At the bound, where its derivative is 0, alpha is far below ALPHA_MIN."""

ALPHA_MIN = 1.0 / 255.0
"""No unit. A splat is not drawn on a pixel where its alpha is below one step of an 8-bit image
(3DGS)."""

ALPHA_MAX = 0.999
"""No unit. Upper bound of alpha, so that the adjoint never divides by 1 - alpha = 0 (gsplat)."""

TRANSMITTANCE_MIN = 1e-4
"""No unit. A pixel is finished when the next splat would leave a transmittance of at most this
(3DGS). That splat and all behind it are not drawn."""

FRUSTUM_MARGIN = 0.3
"""Share of the half field of view. EWA splatting approximates the projection by its Jacobian at
a Gaussian's centre, clamped to the image and this margin around it (3DGS's factor 1.3), because the
approximation fails far outside the image."""

NEAR = 0.01
"""Metres. Near plane: Gaussians whose centre is nearer are not drawn."""

LOG_SCALE_RANGE = (-16.0, 9.0)
"""ln m. Log-scales are clamped to this range (0.1 micrometre to 8 km), beyond which float32
covariances overflow. Outside it, the derivative by the log-scale is 0."""
