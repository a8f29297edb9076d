"""The one procedural world: exact surfaces, and the pictures that cameras take of them; no Gaussian is in it.

`world` has balls and walls for experiments, `court` the court of `abcd demo`, `land` as much as one wants.
"""
