"""`abcd poses`: `mapping` runs pycolmap in a process of its own, which can be stopped."""
