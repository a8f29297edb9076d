"""Files that hold Gaussians, as other programs read them.

`scene_file` knows the suffixes and sizes; `ply` and `glb` are written part by part, `packed` all at once.
"""
