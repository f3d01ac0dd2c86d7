"""What the paper printed: Choi, Cho, Kim, Kim, "Revisiting Pose Sensitivity in Splat-based Computed Tomography under
Sparse-view Reconstruction", CVPR 2026. Truths of 256^3 voxels and 512^2 pixels, 30,000 steps, 75 views unless said;
PSNR in dB, SSIM. Pairs are (R2-Gaussian, the paper's method).
"""

from __future__ import annotations

PSNR_0P03 = {  # sigma 0.03 rad, 1 voxel
    "chest": (26.69, 30.44), "head": (30.91, 34.84), "bonsai": (26.61, 30.05), "engine": (24.69, 31.60),
    "teapot": (36.65, 43.43),
}  # fmt: skip

HEAD_BY_NOISE = {  # (rad, voxels) -> PSNR
    (0.0, 0.0): (40.99, 40.92), (0.01, 0.5): (35.29, 37.87), (0.02, 1.0): (32.25, 35.63), (0.05, 2.5): (28.53, 32.61),
    (0.1, 5.0): (26.41, 28.17),
}  # fmt: skip

MEAN_BY_VIEWS = {75: (28.50, 33.42), 50: (27.67, 31.73), 25: (26.44, 29.02)}  # over its 15 scenes, sigma 0.03 / 1

MEAN_ROT_DEG, MEAN_TRANS_VOX = 0.627, 0.726  # over its 15 scenes, 75 views
MEAN_MINUTES = 20.89  # a scene on an RTX A6000

R2_PUBLISHED = {"teapot": 48.1, "bonsai": 35.6, "engine": 40.2}  # R2-Gaussian's own, true poses, 75 views, 256^3
