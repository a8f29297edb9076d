"""`abcd mesh`: `depth_maps` draws, `fusion` makes of these a surface, part by part."""
