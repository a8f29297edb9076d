"""What ABCD is compared with, built from the same engine: exact gradients, and blocks that train alone."""
