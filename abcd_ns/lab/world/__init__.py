"""The one procedural world: exact surfaces, and the pictures that cameras take of them; no Gaussian is in it.

`world` has balls and walls for experiments and `abcd demo`, `land` as much as one wants.
"""
