"""`abcd synth`: the courts of the procedural world as a COLMAP data set.

`sparse_points` has points with their observations, and writes the model.
"""
