"""The rasterizer that hands the work to gsplat's CUDA kernels."""
