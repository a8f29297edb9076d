"""`abcd scale`: memory and time as the scene grows and the block does not.

`worker` makes one measurement, `charts` draws them all.
"""
