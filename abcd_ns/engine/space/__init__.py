"""Blocks as regions of space: the tree of cells, what lies before what, and what a view can see of which.

Nothing here is trained; the blocks' order and windows of `layers` and the plans of `train` are made of it.
"""
