"""What is found of each photo beside the scene: the light that it was taken in, and from where.

Numbers of the run and not of a block: poses are kept with its state, light in tables beside its blocks.
"""
