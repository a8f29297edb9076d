"""What ABCD is, in torch: no nerfstudio, no user interface.

From the ground up: `types`, `kernels`, `gaussians`, `render`, `space`, `store`, `layers`, `train`. A
folder may use those before it. `train.coordinator` is where to begin to read.
"""
