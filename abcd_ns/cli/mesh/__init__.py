"""`abcd mesh`: the surface of a trained scene, from the depths that its training views see.

`depth_maps` draws, `fusion` makes of these a surface part by part, `surface` cleans it.
"""
