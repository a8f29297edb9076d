"""Gaussians as data: their first values, other frames, a block's state, and that state in an optimizer.

`block_state` is what travels: parameters, moments and counts of one block.
"""
