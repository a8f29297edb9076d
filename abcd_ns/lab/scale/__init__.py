"""`abcd scale`: memory and time as the scene grows and the block does not."""
