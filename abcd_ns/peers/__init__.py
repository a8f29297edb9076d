"""What ABCD is compared with, built from the same engine.

`exact` trains all blocks at once by exact gradients, `independent` each block alone.
"""
