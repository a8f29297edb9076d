"""`abcd poses`: camera poses and points for a folder of photos.

`mapping` runs pycolmap in a process of its own, which can be stopped.
"""
