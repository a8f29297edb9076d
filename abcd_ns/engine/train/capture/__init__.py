"""What is found of each photo beside the scene: the light that it was taken in, and from where.

Numbers of the run and not of a block, kept with the run's state (poses) or in tables beside its blocks (light).
"""
